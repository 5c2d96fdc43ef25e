"""Compile node/tipforce/_core.c beside its source: a build hook of hatchling, and by hand `python tools/build_core.py`.
Without a compiler, or Python's headers, nothing is built, and tipforce is the same, slower."""

import sys
import sysconfig
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = Path("node", "tipforce")


def build() -> bool:
    """Return whether the core was built."""
    try:
        from setuptools import Distribution, Extension

        source = str(ROOT / PACKAGE / "_core.c")
        exact = [] if sys.platform == "win32" else ["-O3", "-ffp-contract=off"]  # the same values on every processor
        core = Extension("tipforce._core", [source], py_limited_api=True, extra_compile_args=exact)
        command = Distribution({"name": "tipforce", "ext_modules": [core]}).get_command_obj("build_ext")
        command.build_lib, command.build_temp = str(ROOT / PACKAGE.parent), str(ROOT / "build" / "core")
        command.force = True
        command.ensure_finalized()
        command.run()
    except Exception as error:  # each compiler has its own
        print(f"tipforce is built without its compiled core: {error}", file=sys.stderr)
        return False
    return True


try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # by hand
    pass
else:

    class CoreHook(BuildHookInterface[Any]):
        """Adds the core to a wheel, or builds it for an editable install."""

        def initialize(self, version: str, build_data: dict[str, Any]) -> None:
            """Build it; the wheel is then one of this platform."""
            del version
            if self.target_name == "wheel" and build():
                platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
                build_data["pure_python"] = False
                build_data["tag"] = f"cp311-abi3-{platform}"
                build_data["artifacts"] += [f"{PACKAGE.as_posix()}/_core.*.so", f"{PACKAGE.as_posix()}/_core.pyd"]


if __name__ == "__main__":
    sys.exit(not build())
