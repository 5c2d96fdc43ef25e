"""Run time and import time of each part of a scene: with it against without it and the parts that depend on it."""

import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from tipforce.scene import Outcome, parts, read_scene, run_scene, schema
from tipforce.shipped_files import shipped_folder
from tipforce_lab.report.study import Effort, Point, Series, Study, quartiles

_LENGTHEN = 4  # ratio of the long run to the short run of a pair: their difference excludes the set-up


Cost = dict[str, float | None]
"""us_per_sample (a node at a SYNC): with less without the part, never negative; of "nodes" the rest. ms_per_run: the
same for set-up and drawing. import_ms: of modules that no earlier part imports. None: cannot be removed alone."""


def part_costs(scene: schema.Scene, path: Path, samples: int = 300, runs: int = 3) -> dict[str, Cost]:
    """Measure every part, and "all": their sum. ``samples``: of a short run; ``runs``: of which the minimum counts."""
    imports = import_times(scene, path)
    ladder = rungs(scene)
    times = measure([step for _, step in ladder], path, samples, runs)
    columns = []  # time per sample (us) and per run (ms) of each step of the ladder, which ends with nothing
    for column in ([measured.us_per_sample for measured in times], [measured.ms_per_run for measured in times]):
        rising = [max(value, 0.0) for value in nondecreasing(column[::-1])]
        columns.append([after - before for before, after in pairwise([0.0, *rising])][::-1])
    work = dict(zip((name for name, _ in ladder), zip(*columns, strict=True), strict=True))
    costs: dict[str, Cost] = {}
    for part in parts(scene):
        us_per_sample, ms_per_run = work.get(part.name, (None, None)) if part.built else (None, None)
        import_ms = imports.get(part.name, 0.0) if part.built else None
        costs[part.name] = {"us_per_sample": us_per_sample, "ms_per_run": ms_per_run, "import_ms": import_ms}
    names = ("us_per_sample", "ms_per_run", "import_ms")
    return costs | {"all": {name: sum(cost[name] or 0.0 for cost in costs.values()) for name in names}}


def nondecreasing(values: Sequence[float]) -> list[float]:
    """Return the nearest sequence (least squares) that does not fall: such a difference is the scatter of the clock."""
    blocks: list[tuple[float, int]] = []
    for value in values:
        blocks.append((value, 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (mean, count), (before, count_before) = blocks.pop(), blocks.pop()
            both = count + count_before
            blocks.append(((mean * count + before * count_before) / both, both))
    return [mean for mean, count in blocks for _ in range(count)]


def rungs(scene: schema.Scene) -> list[tuple[str, schema.Scene]]:
    """Return (part, the scene with it and without all previous parts): each step removes one part, down to "nodes"."""
    left, ladder = scene, []
    built = {part.name for part in parts(scene) if part.built}
    for name, take in _TAKE:
        if name in built:
            ladder.append((name, left))
            left = take(left)
    return [*ladder, ("nodes", left)]


def _nodes(scene: schema.Scene, **changes: object) -> schema.Scene:
    return replace(scene, nodes=tuple(replace(group, **changes) for group in scene.nodes))


def _stand_still(scene: schema.Scene) -> schema.Scene:
    loads = []
    for node_id in scene.node_ids:
        if (load := scene.load(node_id)) is not None:
            _, P, phi, theta = max(load.knots, key=lambda knot: knot[1])
            loads.append(schema.Static(nodes=(node_id,), P_N=P, phi_deg=phi, theta_deg=theta))
    return replace(scene, loads=tuple(loads))


def _noise(scene: schema.Scene, **changes: object) -> schema.Scene:
    return replace(scene, noise=replace(scene.noise or schema.Noise(), **changes))


_COLD: dict[str, Any] = dict.fromkeys(("temperature_degC", "apparent_microstrain_per_degC", "gain_drift_ppm_per_degC"))


def _no_output(name: str) -> Callable[[schema.Scene], schema.Scene]:
    return lambda scene: replace(scene, outputs=replace(scene.outputs, **{name: None}))


# In order of removal: dependent parts first, then the most expensive of the rest, so that small costs are differences
# of small numbers. The cost of a filter is that the converter runs continuously and not only at SYNCs.
_TAKE: tuple[tuple[str, Callable[[schema.Scene], schema.Scene]], ...] = (
    ("plot", _no_output("plot")),
    ("filter", lambda scene: _nodes(scene, filter=None)),
    ("dynamics", lambda scene: replace(scene, dynamics=None)),
    ("table", _no_output("table")),
    ("log", _no_output("log")),
    ("expectations", lambda scene: replace(scene, expect=())),
    ("slit", lambda scene: replace(scene, slit=None)),
    ("faults", lambda scene: replace(scene, faults=())),
    # An uncalibrated node sends the same PDOs and computes neither force nor contact.
    ("contact in the node", lambda scene: _nodes(scene, calibration="none")),
    ("decoder", lambda scene: _nodes(scene, pdos=())),
    ("temperature", lambda scene: replace(scene, front_end=replace(scene.front_end or schema.FrontEnd(), **_COLD))),
    ("1/f noise", lambda scene: _noise(scene, one_over_f_microstrain=None)),
    ("front end", lambda scene: replace(scene, front_end=None)),
    ("noise", lambda scene: _noise(scene, gauge_microstrain=None)),
    ("load history", _stand_still),
    ("structure", lambda scene: replace(scene, loads=())),
)


@dataclass(frozen=True, slots=True)
class Measured:
    """One scene, timed. Processor time."""

    us_per_sample: float
    ms_per_run: float
    seconds: tuple[float, ...]
    """Time per sample of each long run, with set-up: their spread is that of the machine."""
    P_rms_newtons: float
    """RMS error of P over the samples of all nodes with a known P; NaN without any."""


def measure(scenes: Sequence[schema.Scene], path: Path, samples: int, runs: int) -> list[Measured]:
    """Time scenes of the file ``path`` without bus, interleaved: the minimum counts, other load only adds time."""
    short: list[list[float]] = [[] for _ in scenes]
    long: list[list[float]] = [[] for _ in scenes]
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="tipforce-cost-") as folder:
        moved = [_in_folder(scene, Path(folder)) for scene in scenes]
        counts = [max(1, samples // len(scene.node_ids)) for scene in moved]
        for scene in moved:
            _timed(scene, path, 1)  # exclude imports and set-up done once per process
        for _ in range(runs):
            outcomes.clear()
            for k, (scene, count) in enumerate(zip(moved, counts, strict=True)):
                short[k].append(_timed(scene, path, count)[0])
                elapsed_s, outcome = _timed(scene, path, _LENGTHEN * count)
                long[k].append(elapsed_s)
                outcomes.append(outcome)
    results = []
    for scene, count, once, more, outcome in zip(moved, counts, short, long, outcomes, strict=True):
        size = count * len(scene.node_ids)
        sample_s = (min(more) - min(once)) / ((_LENGTHEN - 1) * size)
        each = tuple(elapsed_s / (_LENGTHEN * size) for elapsed_s in more)
        known = [(finger.known[0], finger.rms_error[0]) for finger in outcome.fingers if finger.known[0]]
        total = sum(count for count, _ in known)
        P_rms = math.sqrt(sum(count * rms * rms for count, rms in known) / total) if total else math.nan
        results.append(Measured(1e6 * sample_s, 1e3 * (min(once) - sample_s * size), each, P_rms))
    return results


def _timed(scene: schema.Scene, path: Path, syncs: int) -> tuple[float, Outcome]:
    started_ns = time.process_time_ns()
    outcome = run_scene(scene, path.parent, syncs / (scene.sync_hz or 100.0))
    return 1e-9 * (time.process_time_ns() - started_ns), outcome


def _in_folder(scene: schema.Scene, folder: Path) -> schema.Scene:
    given = {name: getattr(scene.outputs, name) for name in ("log", "table", "plot")}
    moved = {name: str(folder / Path(path).name) for name, path in given.items() if path is not None}
    return replace(scene, bus=None, outputs=replace(scene.outputs, **moved))


_IMPORT_RUN = """
import sys
from pathlib import Path
import msgspec
from tipforce.scene.schema import Scene
from tipforce.scene.run import Outcome, run_scene
scene = msgspec.json.decode(sys.argv[1], type=Scene)
run_scene(scene, Path(sys.argv[2]), 1.5 / (scene.sync_hz or 1.0))
"""


def import_times(scene: schema.Scene, path: Path) -> dict[str, float]:
    """Return the milliseconds of each part's imports, in another process; a module counts for the first part of it."""
    with tempfile.TemporaryDirectory(prefix="tipforce-cost-") as folder:
        text = msgspec.json.encode(_in_folder(scene, Path(folder))).decode()
        words = [sys.executable, "-X", "importtime", "-c", _IMPORT_RUN, text, str(path.parent)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
    owners: dict[str, str] = {}
    for part in parts(scene):
        for module in part.modules if part.built else ():
            owners.setdefault(module, part.name)
    ms_by_part: dict[str, float] = {}
    for line in done.stderr.splitlines():
        if not line.startswith("import time:") or "cumulative" in line:
            continue
        own_us, total_us, name = line.removeprefix("import time:").split("|")
        module = name.strip()
        if module in owners:
            # Imports of another package, including further packages, count for the module that imports it.
            us = own_us if module.startswith("tipforce") else total_us
            ms_by_part[owners[module]] = ms_by_part.get(owners[module], 0.0) + 1e-3 * int(us)
    return ms_by_part


SCENES = ("static", "full")
STEPS = len(SCENES)


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return the study of the report: each scene with its parts removed in sequence, down to the bare nodes."""
    series = []
    for name in SCENES:
        path = shipped_folder("scenes") / f"{name}.toml"
        scene = read_scene(path)
        # A plot takes longer than all other parts and does not grow with the samples.
        ladder = rungs(replace(scene, outputs=replace(scene.outputs, plot=None)))
        results = measure([scene for _, scene in ladder], path, effort.pick(100, 300), effort.pick(3, 7))
        settings = ["all parts", *(f"less {part}" for part, _ in ladder[:-1])]
        points = (
            Point(setting, result.P_rms_newtons, quartiles(result.seconds))
            for setting, result in zip(settings, results, strict=True)
        )
        series.append(Series(name, tuple(points)))
        advance()
    whole, least = (scene_series.points[0].timing.seconds for scene_series in reversed(series))
    return [
        Study(
            "scenes", "What a scene builds: run time and error of P, part by part", "RMS error of P, N",
            "s per sample", "the load that the scene applies", 0.0, tuple(series),
            remarks=(
                f"The scene that names everything takes {whole / least:.0f} times as long per sample as the static.",
                "A sample is one node at one SYNC; processor time of a whole run, building included.",
                "Each row takes one more part away. Without the contact in the nodes there is no P, so no error.",
                "With a filter the converter runs continuously, not only at SYNCs: its own step includes that.",
            ),
        )
    ]  # fmt: skip
