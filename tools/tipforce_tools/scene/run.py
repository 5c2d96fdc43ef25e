"""`tipforce run SCENE`: run a scene file and print a table of results, one row per finger."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from rich.table import Table

    from tipforce.scene.results import Check, FingerResult
    from tipforce.scene.run import Options, Outcome

_KEYS = ("P_N", "phi_deg", "theta_deg")
_DIGITS = (3, 2, 2)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce run`. Three bus flags are defined here: only runs on a bus import python-can."""
    parser.epilog = (
        "Time is simulated, without a bus and without waiting, unless the scene has a [bus] or a bus flag is given.\n"
        "Exit code 1: an expectation of the scene ([[expect]]) did not hold.\n"
        "  tipforce run grasp\n"
        "  tipforce run grasp --duration 60 -i socketcan -c vcan0"
    )
    parser.add_argument(
        "scene", metavar="SCENE", help="a TOML file (docs/scenes.md), or the name of a shipped scene: grasp"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="instead of the scene's duration_s")
    parser.add_argument("--seed", type=common.seed, metavar="N", help="instead of the scene's seed")
    parser.add_argument("-o", "--log", metavar="LOG", help="write every frame to this file, as candump -L does")
    group = parser.add_argument_group("bus (in real time)")
    group.add_argument("-i", "--interface", help="python-can interface: socketcan, virtual, ...")
    group.add_argument("-c", "--channel", help="for example vcan0")
    group.add_argument("-b", "--bitrate", type=int, metavar="BIT/S", help="if the interface sets it")
    group.add_argument("--realtime", action="store_true", help="without -i and -c: on a bus inside this process")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the scene; return 0, or 1 if an expectation did not hold."""
    from tipforce.scene.reader import read_scene
    from tipforce.scene.registry import bus_load
    from tipforce.scene.run import run_scene
    from tipforce.shipped_files import file_or_shipped

    path = file_or_shipped(args.scene, "scenes")
    scene = read_scene(path)
    options = _options(args)
    if bus_load(scene)[0] > 1.0:
        common.note(
            args, f"{path}: too much for a bus of {scene.bit_rate} bit/s: {100 * bus_load(scene)[0]:.0f} % load"
        )
    started_s = time.monotonic()
    with common.progress(args, "simulated seconds", options.duration_s or scene.duration_s, absolute=True) as advance:
        outcome = run_scene(scene, path.parent, options, advance)
    if args.json:
        _print_json(outcome)
    else:
        common.print_table(args, _table(scene.title or args.scene, outcome))
        _print_checks(args, outcome)
    frames = sum(outcome.frames_by_id.values())
    common.note(
        args,
        f"{outcome.duration_s:g} s with {outcome.syncs} SYNCs and {frames} frames, in "
        f"{time.monotonic() - started_s:.1f} s" + "".join(f"; wrote {path}" for path in outcome.files),
    )
    return 0 if outcome.ok else 1


def _options(args: argparse.Namespace) -> Options:
    from tipforce.scene.run import Options
    from tipforce.scene.schema import Bus

    named = any(value is not None for value in (args.interface, args.channel, args.bitrate))
    bus = Bus(interface=args.interface, channel=args.channel, bitrate=args.bitrate) if named else None
    return Options(args.duration, args.seed, args.log, bus, args.realtime)


def _table(title: str, outcome: Outcome) -> Table:
    from rich.table import Table

    table = Table(title=f"{title}: at the end, and errors over all samples with a known value", title_justify="left")
    table.add_column("node", justify="right")
    table.add_column("samples", justify="right")
    table.add_column("", justify="left", no_wrap=True)
    for name in ("applied", "estimated", "RMS error", "max error"):
        table.add_column(name, justify="right")
    table.add_column("missing", justify="left")
    table.add_column("EMCY", justify="left")
    for finger in outcome.fingers:
        columns = (finger.applied_end, finger.estimated_end, finger.rms_error, finger.max_error)
        table.add_row(
            common.shown_id(finger.node_id),
            f"{finger.samples}\nof {finger.syncs}",
            "P N\nphi deg\ntheta deg",
            *("\n".join(_number(value, digits) for value, digits in zip(triple, _DIGITS, strict=True))
              for triple in columns),
            _remarks(finger),
            _counts(finger.emcy),
            end_section=True,
        )  # fmt: skip
    return table


def _number(value: float, digits: int) -> str:
    return "-" if value != value else f"{value:.{digits}f}"  # noqa: PLR0124 (NaN)


def _remarks(finger: FingerResult) -> str:
    """Return the missing values with their reasons, and the limits of the simulation that were exceeded."""
    closed = {"slit closed: not linear": finger.slit_closed} if finger.slit_closed else {}
    return _counts({**finger.missing, **closed})


def _counts(counts: dict[str, int]) -> str:
    return "\n".join(f"{count} {name}" for name, count in counts.items()) or "-"


def _print_checks(args: argparse.Namespace, outcome: Outcome) -> None:
    if outcome.checks:
        common.print_table(args, _checks_table(outcome.checks))
    held, failed, open_ = (sum(check.ok is verdict for check in outcome.checks) for verdict in (True, False, None))
    if outcome.checks:
        word = "FAIL" if failed else "PASS" if held else "NOT JUDGED"
        rest = f", {open_} not judged (the run was too short)" if open_ else ""
        print(f"{word}: {held} of {len(outcome.checks)} expectations hold, {failed} do not{rest}")


def _checks_table(checks: Sequence[Check]) -> Table:
    """Return a row for each expectation and verdict, with its nodes."""
    from rich.table import Table

    rows: dict[tuple[str, str], list[Check]] = {}
    for check in checks:
        rows.setdefault((check.expected, _verdict(check)), []).append(check)
    table = Table(title="expectations of the scene", title_justify="left")
    for heading in ("", "expected", "nodes", "found"):
        table.add_column(heading, justify="left")
    for (expected, verdict), alike in rows.items():
        nodes = ",".join(str(check.node_id) for check in alike)
        found = ", ".join(dict.fromkeys(check.found for check in alike))
        table.add_row(verdict, expected, nodes, found, style="bold red" if verdict == "FAILED" else None)
    return table


def _verdict(check: Check) -> str:
    return "not judged" if check.ok is None else "ok" if check.ok else "FAILED"


def _print_json(outcome: Outcome) -> None:
    for finger in outcome.fingers:
        common.print_json(_finger_record(finger))
    for check in outcome.checks:
        common.print_json(
            {"node": check.node_id, "expected": check.expected, "found": check.found, "verdict": _verdict(check)}
        )
    common.print_json(
        {
            "summary": True, "ok": outcome.ok, "duration_s": outcome.duration_s, "syncs": outcome.syncs,
            "built": list(outcome.built), "files": list(outcome.files),
            "frames": {f"0x{can_id:03X}": count for can_id, count in sorted(outcome.frames_by_id.items())},
        }
    )  # fmt: skip


def _finger_record(finger: FingerResult) -> dict[str, object]:
    record: dict[str, object] = {"node": finger.node_id, "syncs": finger.syncs, "samples": finger.samples}
    for name, triple in (
        ("applied", finger.applied_end),
        ("estimated", finger.estimated_end),
        ("rms_error", finger.rms_error),
        ("max_error", finger.max_error),
        ("known", finger.known),
    ):
        for key, value in zip(_KEYS, triple, strict=True):
            record[f"{name}_{key}"] = value
    return {**record, "slit_closed": finger.slit_closed, "missing": finger.missing, "emcy": finger.emcy}
