"""The exported C estimator: agreement with Python over random samples, and its size on a Cortex-M4.

    python -m bench.export_c                        a million samples (minutes), and the sizes
    python -m bench.export_c --samples 20000        fewer
    python -m bench.export_c --json

Every sample is held to the bound derived in tests/export_c/estimators.py; the first one beyond it ends the run. Sizes
want arm-none-eabi-gcc (apt: gcc-arm-none-eabi, libnewlib-arm-none-eabi); without it they are left out, and it says so.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

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


def agreement(samples: int, seed: int) -> dict[str, Any]:
    """The largest deviations of each variant. Raises AssertionError at a sample beyond its bound."""
    from export_c import estimators

    with tempfile.TemporaryDirectory() as folder:
        programs = {
            real: estimators.build(Path(folder) / real, 3, real, estimators.SANITIZE) for real in estimators.REALS
        }
        return {name: asdict(tally) for name, tally in estimators.compare(programs, 3, samples, seed).items()}


def sizes() -> dict[str, dict[str, int]] | None:
    """Bytes of each file as compiled, and of each variant with what it needs of the library; None without gcc."""
    if shutil.which(ARM) is None:
        return None
    from export_c import estimators
    from tipforce_tools.export_c.files import write_c_files

    flags = [*estimators.HOST_FLAGS[:-1], *CPU]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_c_files(folder, 3)
        compiled = {}
        for source in sorted(folder.glob("*.c")):
            _run([ARM, *flags, "-c", source.name, "-o", f"{source.stem}.o"], folder)
            compiled[source.name] = _text(folder / f"{source.stem}.o")
        linked = {title: _linked(folder, functions, files) for title, (functions, files) in PROGRAMS.items()}
    return {"compiled": compiled, "linked": linked}


def _linked(folder: Path, functions: list[str], files: list[str]) -> int:
    objects = [f"{Path(name).stem}.o" for name in files]
    kept = [f"-Wl,--undefined={function}" for function in functions]
    line = [ARM, *CPU, "-nostartfiles", "-Wl,--gc-sections", f"-Wl,--entry={functions[0]}", *kept]
    _run([*line, "--specs=nosys.specs", "--specs=nano.specs", *objects, "-lm", "-o", "linked.elf"], folder)
    return _text(folder / "linked.elf")


def _run(line: list[str], folder: Path) -> None:
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(line)}\n{done.stderr}")


def _text(path: Path) -> int:
    """Code and constants in flash."""
    done = subprocess.run(["arm-none-eabi-size", str(path)], capture_output=True, text=True, check=True)
    return int(done.stdout.splitlines()[1].split()[0])


def table(found: dict[str, Any]) -> str:
    """For people."""
    rows = [
        f"{'largest deviation':17}{'samples':>10}{'P, uN':>10}{'phi, deg':>10}{'theta, deg':>11}{'u, %':>9}{'limit':>7}"
    ]
    for name, t in found["agreement"].items():
        rows.append(
            f"{name:17}{t['samples']:>10}{1e6 * t['P']:10.3g}{t['ordinary_phi_deg']:10.1e}"
            f"{t['ordinary_theta_deg']:11.1e}{100 * t['uncertainty']:9.1e}{t['status_at_a_limit']:>7}"
        )
    if found["sizes"] is None:
        return "\n".join([*rows, "", f"no sizes: {ARM} is missing (apt: gcc-arm-none-eabi, libnewlib-arm-none-eabi)"])
    rows += ["", f"Cortex-M4F, {' '.join(CPU)}: bytes of code and constants"]
    for title, sized in found["sizes"].items():
        rows += [f"  {title}:", *(f"    {name:28}{size:8}" for name, size in sized.items())]
    return "\n".join(rows)


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=SAMPLES, metavar="N", help="default %(default)s")
    parser.add_argument("--seed", type=int, default=SEED, help="default %(default)s")
    parser.add_argument("--json", action="store_true", help="JSON instead of a table")
    args = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    found = {"agreement": agreement(args.samples, args.seed), "sizes": sizes()}
    print(json.dumps(found, indent=1) if args.json else table(found))


if __name__ == "__main__":
    main()
