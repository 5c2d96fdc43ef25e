"""`python -m bench.export_c`: the exported C estimator: agreement with Python, and its size on a Cortex-M4.

Every sample is held to the bound derived in tests/export_c/estimators.py; the first one beyond it ends the run."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from bench.measure import ROOT, arguments, table

SAMPLES, SEED = 1_000_000, 2025
ARM = "arm-none-eabi-gcc"
CPU = ["-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os"]
# Functions that a program calls, and the files they need; what the linker keeps of the library counts.
PROGRAMS = {
    "float": (["tipforce_float_estimate"], ["tipforce_float.c", "tipforce_status.c"]),
    "float, judging": (
        ["tipforce_judge_setup", "tipforce_judge_sample", "tipforce_judge_estimate"],
        ["tipforce_judge.c", "tipforce_float.c", "tipforce_status.c"],
    ),
    "fixed point": (["tipforce_fixed_estimate"], ["tipforce_fixed.c", "tipforce_status.c"]),
    "fixed point and its setup": (
        ["tipforce_fixed_estimate", "tipforce_fixed_setup"],
        ["tipforce_fixed.c", "tipforce_fixed_setup.c", "tipforce_status.c"],
    ),
    "dictionary": (["tipforce_od_find"], ["tipforce_od.c"]),
}


def sizes() -> dict[str, int] | None:
    """Bytes of each file as compiled, and of each variant with what it needs of the library; None without gcc."""
    if shutil.which(ARM) is None:
        return None
    from export_c import estimators
    from tipforce_tools.export import write_c_files

    flags = [*estimators.HOST_FLAGS[:-1], *CPU]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_c_files(folder, 3)
        bytes_of = {}
        for source in sorted(folder.glob("*.c")):
            subprocess.run([ARM, *flags, "-c", source.name, "-o", f"{source.stem}.o"], cwd=folder, check=True)
            bytes_of[f"compiled {source.name}"] = _text(folder / f"{source.stem}.o")
        for title, (functions, files) in PROGRAMS.items():
            objects = [f"{Path(name).stem}.o" for name in files]
            kept = [f"-Wl,--undefined={function}" for function in functions]
            line = [ARM, *CPU, "-nostartfiles", "-Wl,--gc-sections", f"-Wl,--entry={functions[0]}", *kept]
            line += ["--specs=nosys.specs", "--specs=nano.specs", *objects, "-lm", "-o", "linked.elf"]
            subprocess.run(line, cwd=folder, check=True)
            bytes_of[f"linked {title}"] = _text(folder / "linked.elf")
    return bytes_of


def _text(path: Path) -> int:
    """Code and constants in flash."""
    done = subprocess.run(["arm-none-eabi-size", str(path)], capture_output=True, text=True, check=True)
    return int(done.stdout.splitlines()[1].split()[0])


def main() -> None:
    """Compare, with the runners of the tests, and print. Raises AssertionError at a sample beyond its bound."""
    arguments(__doc__).parse_args()
    sys.path.insert(0, str(ROOT / "tests"))
    from export_c import estimators

    with tempfile.TemporaryDirectory() as folder:
        libraries = {real: estimators.Library(Path(folder) / real, 3, real) for real in estimators.REALS}
        tallies = estimators.compare(libraries, SAMPLES, SEED)
    rows = [
        [name, f"{t.samples}", f"{1e6 * t.P:.3g}", f"{t.ordinary_phi_deg:.1e}", f"{t.ordinary_theta_deg:.1e}",
         f"{100 * t.uncertainty:.1e}", f"{t.status_at_a_limit}"] for name, t in tallies.items()
    ]  # fmt: skip
    header = ["largest deviation", "samples", "P, uN", "phi, deg", "theta, deg", "u, %", "limit"]
    print(table(header, rows, markdown=False), end="\n\n")
    bytes_of = sizes()
    if bytes_of is None:
        print(f"no sizes: {ARM} is missing (apt: gcc-arm-none-eabi, libnewlib-arm-none-eabi)")
    else:
        rows = [[name, str(size)] for name, size in bytes_of.items()]
        print(table([f"Cortex-M4F, {' '.join(CPU)}", "bytes of code and constants"], rows, markdown=False))


if __name__ == "__main__":
    main()
