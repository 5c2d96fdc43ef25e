"""`tipforce scene explain SCENE`: the parts built and left out, the frames on the bus, the cost of each part."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.scene.registry import Identifier
    from tipforce.scene.schema import Scene

_SHOWN_MODULES = 8
_COSTS = ("us_per_sample", "ms_per_run", "import_ms")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce scene explain`."""
    parser.add_argument("scene", metavar="SCENE", help="a TOML file, or the name of a shipped scene: grasp")
    parser.add_argument("--cost", action="store_true", help="measure the run time and import time of each part")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Explain; 0."""
    from tipforce.scene.reader import read_scene
    from tipforce.scene.registry import bus_load, identifiers, parts
    from tipforce.shipped_files import file_or_shipped

    path = file_or_shipped(args.scene, "scenes")
    scene = read_scene(path)
    costs: dict[str, Any] = {}
    if args.cost:
        from tipforce_lab.scene_cost import part_costs

        costs = part_costs(scene, path)
    rows = [
        {
            "part": part.name, "built": part.built, "why": part.why, "modules": list(part.modules),
            "on_demand": list(part.on_demand),
            **costs.get(part.name, {}),
        }
        for part in parts(scene)
    ]  # fmt: skip
    if args.cost:
        rows.append({"part": "all", "built": True, "why": "", "modules": [], "on_demand": [], **costs["all"]})
    sent = [_sent(scene, one) for one in identifiers(scene)]
    low, high = bus_load(scene)
    load = {"bit_rate": scene.bit_rate, "bus_load": low, "bus_load_at_most": high}
    if args.json:
        for record in [*rows, *sent, load]:
            common.print_json(record)
        return 0
    _print_parts(args, rows)
    _print_identifiers(args, sent)
    fits = "" if high <= 1.0 else " (with the most stuff bits it does not fit)" if low <= 1.0 else " (it does not fit)"
    print(
        f"bus load at {scene.bit_rate} bit/s: {100 * low:.1f} % without stuff bits, {100 * high:.1f} % with the most "
        f"stuff bits{fits}"
    )
    return 0


def _sent(scene: Scene, one: Identifier) -> dict[str, Any]:
    low, high = (one.rate_hz * bits / scene.bit_rate for bits in one.bits)
    return {
        "cob_id": f"0x{one.can_id:03X}", "what": one.what, "rate_hz": one.rate_hz, "data_bytes": one.data_bytes,
        "load": low, "load_at_most": high,
    }  # fmt: skip


def _print_parts(args: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(title=f"{args.scene}: parts", title_justify="left")
    for heading in ("part", "", "why"):
        table.add_column(heading)
    if args.cost:
        table.add_column("us per sample", justify="right")
        table.add_column("ms per run", justify="right")
        table.add_column("import ms", justify="right")
    table.add_column("loads", overflow="fold")
    for row in rows:
        cells = [row["part"], "built" if row["built"] else "left out", row["why"]]
        if args.cost:
            cells += ["" if row.get(key) is None else f"{row[key]:.1f}" for key in _COSTS]
        table.add_row(*cells, _short(row["modules"]) if row["built"] else "", style=None if row["built"] else "dim")
    common.print_table(args, table)


def _short(modules: list[str]) -> str:
    """Format modules by package: `sensor: geometry strain; numpy`. A long list is counted: --json has the names."""
    packages: dict[str, list[str]] = {}
    for name in dict.fromkeys(modules):
        package, _, last = name.removeprefix("tipforce.").rpartition(".")
        if not name.startswith(("tipforce", "canopen_device")):
            packages.setdefault(name, [])
        elif package:
            packages.setdefault(package, []).append(last)
    lines = []
    for package, names in packages.items():
        shown = f"{len(names)} modules" if len(names) > _SHOWN_MODULES else " ".join(names)
        lines.append(f"{package}: {shown}" if names else package)
    return "; ".join(lines)


def _print_identifiers(args: argparse.Namespace, sent: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(title="COB-IDs sent (EMCY only on an error)", title_justify="left")
    for heading, justify in (("COB-ID", "left"), ("", "left"), ("rate", "right"), ("data", "right"), ("load", "right")):
        table.add_column(heading, justify="right" if justify == "right" else "left")
    for one in sent:
        rate = f"{one['rate_hz']:g} Hz" if one["rate_hz"] else "once"
        load = f"{100 * one['load']:.2f} %" if one["rate_hz"] else ""
        table.add_row(one["cob_id"], one["what"], rate, f"{one['data_bytes']} bytes", load)
    common.print_table(args, table)
