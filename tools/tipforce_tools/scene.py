"""`tipforce run SCENE`: run a scene file and print results; with `--explain`: what it builds, and why."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from tipforce_tools.cli import bus_flags, common, log_flags, tables

if TYPE_CHECKING:
    from pathlib import Path

    from tipforce.scene.results import Check
    from tipforce.scene.run import Outcome
    from tipforce.scene.schema import Scene


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Time is simulated, without a bus and without waiting, unless the scene has a [bus] or a bus flag is given.
    Exit code 1: an expectation of the scene ([[expect]]) did not hold.
      tipforce run grasp --duration 60 -i socketcan -c vcan0
    """
    parser.add_argument("scene", metavar="SCENE", help="a TOML file, or a shipped scene: grasp")
    parser.add_argument("--duration", type=float, metavar="S", help="instead of the scene's duration_s")
    parser.add_argument("--seed", type=common.whole_number, metavar="N", help="instead of the scene's seed")
    parser.add_argument("-o", "--log", metavar="LOG", help="write every frame to this file, as candump -L does")
    parser.add_argument("--explain", action="store_true", help="run nothing: list what is built and left out, and why")
    parser.add_argument("--cost", action="store_true", help="explain, and measure each part's run and import time")
    parser.add_argument("--realtime", action="store_true", help="without -i and -c: on a bus inside this process")
    bus_flags.add_bus_name_arguments(parser)
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run or explain the scene; return 0, or 1 if an expectation did not hold."""
    path = log_flags.scene_or_file(args.scene)
    from tipforce.scene.reader import read_scene
    from tipforce.scene.registry import bus_load

    scene = read_scene(path)
    if args.explain or args.cost:
        return _explain(path, scene, args.scene, args.cost)
    from msgspec.structs import replace

    from tipforce.scene.run import run_scene
    from tipforce.scene.schema import Bus

    outputs = scene.outputs if args.log is None else replace(scene.outputs, log=args.log)
    seed = scene.seed if args.seed is None else args.seed
    bus = bus_flags.bus_options(args)
    scene = replace(scene, seed=seed, outputs=outputs, bus=Bus(**bus) if bus else scene.bus)
    if bus_load(scene)[0] > 1.0:
        common.note(f"{path}: too much for a bus of {scene.bit_rate} bit/s: {100 * bus_load(scene)[0]:.0f} % load")
    started_s = time.monotonic()
    with common.progress("simulated seconds", args.duration or scene.duration_s, absolute=True) as advance:
        outcome = run_scene(scene, path.parent, args.duration, realtime=args.realtime, advance=advance)
    if common.OUTPUT.json:
        _print_outcome(outcome)
    else:
        _print_fingers(scene.title or args.scene, outcome)
        _print_checks(outcome)
    frames = sum(outcome.frames_by_id.values())
    common.note(
        f"{outcome.duration_s:g} s with {outcome.syncs} SYNCs and {frames} frames, in "
        f"{time.monotonic() - started_s:.1f} s" + "".join(f"; wrote {path}" for path in outcome.files)
    )
    return 0 if outcome.ok else 1


def _print_fingers(title: str, outcome: Outcome) -> None:
    rows = []
    for finger in outcome.fingers:
        columns = (finger.applied_end, finger.estimated_end, finger.rms_error, finger.max_error)
        values = ["{:.3f}\n{:.2f}\n{:.2f}".format(*triple).replace("nan", "-") for triple in columns]
        closed = {"slit closed: not linear": finger.slit_closed} if finger.slit_closed else {}
        counts = (
            "\n".join(f"{count} {name}" for name, count in named.items()) or "-"
            for named in (finger.missing | closed, finger.emcy)
        )
        samples = f"{finger.samples}\nof {finger.syncs}"
        rows.append([common.shown_id(finger.node_id), samples, "P N\nphi deg\ntheta deg", *values, *counts])
    title = f"{title}: at the end, and errors over all samples with a known value"
    headings = (">node", ">samples", "", ">applied", ">estimated", ">RMS error", ">max error", "missing", "EMCY")
    tables.print_rows(title, headings, rows, lines=True)


def _print_checks(outcome: Outcome) -> None:
    rows: dict[tuple[str, str], list[Check]] = {}
    for check in outcome.checks:
        rows.setdefault((_verdict(check), check.expected), []).append(check)
    if not rows:
        return
    cells = [
        (*key, ",".join(str(check.node_id) for check in alike), ", ".join(dict.fromkeys(each.found for each in alike)))
        for key, alike in rows.items()
    ]
    styles = ["bold red" if verdict == "FAILED" else None for verdict, _ in rows]
    tables.print_rows("expectations of the scene", ("", "expected", "nodes", "found"), cells, styles)
    held, failed, unjudged = (sum(check.ok is verdict for check in outcome.checks) for verdict in (True, False, None))
    word = "FAIL" if failed else "PASS" if held else "NOT JUDGED"
    rest = f", {unjudged} not judged (the run was too short)" if unjudged else ""
    print(f"{word}: {held} of {len(outcome.checks)} expectations hold, {failed} do not{rest}")


def _verdict(check: Check) -> str:
    return "not judged" if check.ok is None else "ok" if check.ok else "FAILED"


def _print_outcome(outcome: Outcome) -> None:
    for finger in outcome.fingers:
        values: dict[str, object] = {"node": finger.node_id, "syncs": finger.syncs, "samples": finger.samples}
        for name in ("applied_end", "estimated_end", "rms_error", "max_error", "known"):
            for key, value in zip(("P_N", "phi_deg", "theta_deg"), getattr(finger, name), strict=True):
                values[f"{name.removesuffix('_end')}_{key}"] = value
        common.print_json({**values, "slit_closed": finger.slit_closed, "missing": finger.missing, "emcy": finger.emcy})
    for check in outcome.checks:
        record = {"node": check.node_id, "expected": check.expected, "found": check.found}
        common.print_json(record | {"verdict": _verdict(check)})
    common.print_json(
        {
            "summary": True, "ok": outcome.ok, "duration_s": outcome.duration_s, "syncs": outcome.syncs,
            "built": list(outcome.built), "files": list(outcome.files),
            "frames": {f"0x{can_id:03X}": count for can_id, count in sorted(outcome.frames_by_id.items())},
        }
    )  # fmt: skip


def _explain(path: Path, scene: Scene, name: str, with_cost: bool) -> int:
    from tipforce.scene.registry import Part, bus_load, identifiers, parts

    costs: dict[str, Any] = {}
    if with_cost:
        from tipforce_lab.scene_cost import part_costs

        costs = part_costs(scene, path)
    rows: list[dict[str, Any]] = [
        {
            "part": part.name, "built": part.built, "why": part.why, "modules": list(part.modules),
            "on_demand": list(part.on_demand), **costs.get(part.name, {}),
        }
        for part in (*parts(scene), *([Part("all", True, "")] if with_cost else ()))
    ]  # fmt: skip
    sent: list[dict[str, Any]] = [
        {
            "cob_id": f"0x{each.can_id:03X}", "what": each.what, "rate_hz": each.rate_hz, "data_bytes": each.data_bytes,
            "load": each.rate_hz * each.bits[0] / scene.bit_rate,
            "load_at_most": each.rate_hz * each.bits[1] / scene.bit_rate,
        }
        for each in identifiers(scene)
    ]  # fmt: skip
    low, high = bus_load(scene)
    if common.OUTPUT.json:
        for record in [*rows, *sent, {"bit_rate": scene.bit_rate, "bus_load": low, "bus_load_at_most": high}]:
            common.print_json(record)
        return 0
    _print_parts(rows, f"{name}: parts", with_cost)
    cells = []
    for record in sent:
        hz, load = (f"{record['rate_hz']:g} Hz", f"{100 * record['load']:.2f} %") if record["rate_hz"] else ("once", "")
        cells.append([record["cob_id"], record["what"], hz, f"{record['data_bytes']} bytes", load])
    tables.print_rows("COB-IDs sent (EMCY only on an error)", ("COB-ID", "", ">rate", ">data", ">load"), cells)
    fits = "" if high <= 1.0 else " (with the most stuff bits it does not fit)" if low <= 1.0 else " (it does not fit)"
    shown = f"{100 * low:.1f} % without stuff bits, {100 * high:.1f} % with the most stuff bits{fits}"
    print(f"bus load at {scene.bit_rate} bit/s: {shown}")
    return 0


def _print_parts(rows: list[dict[str, Any]], title: str, with_cost: bool) -> None:
    costs = ("us_per_sample", "ms_per_run", "import_ms") if with_cost else ()
    cells = []
    for row in rows:
        spent = ("" if row.get(key) is None else f"{row[key]:.1f}" for key in costs)
        loads = _short(row["modules"]) if row["built"] else ""
        cells.append([row["part"], "built" if row["built"] else "left out", row["why"], *spent, loads])
    headings = ("part", "", "why", *(f">{key.replace('_', ' ')}" for key in costs), "loads")
    tables.print_rows(title, headings, cells, [None if row["built"] else "dim" for row in rows])


def _short(modules: list[str]) -> str:
    """Format modules by package: `sensor: geometry strain; numpy`. A long list is counted: --json has the names."""
    packages: dict[str, list[str]] = {}
    for name in dict.fromkeys(modules):
        package, _, last = name.removeprefix("tipforce.").rpartition(".")
        if not name.startswith(("tipforce", "canopen_device")):
            packages.setdefault(name, [])
        elif package:
            packages.setdefault(package, []).append(last)
    shown = {
        package: f"{len(names)} modules" if len(names) > 8 else " ".join(names) for package, names in packages.items()
    }
    return "; ".join(f"{package}: {names}" if names else package for package, names in shown.items())
