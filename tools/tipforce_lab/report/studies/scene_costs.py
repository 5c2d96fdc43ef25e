"""Cost of each part of a scene, for the smallest scene and the one with all parts: a table of the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tipforce.shipped_files import shipped_folder
from tipforce_lab.report.study import Effort, Point, Series, Study, quartiles

SCENES = ("static", "full")
ALL = "all"
STEPS = len(SCENES)


@dataclass(frozen=True, slots=True)
class SceneCost:
    """One part of one scene; the part ``all`` is the whole scene. A sample is one node at one SYNC."""

    scene: str
    part: str
    built: bool
    us_per_sample: float | None
    """Difference of processor time with and without the part. None: left out, or not removable alone."""
    ms_per_run: float | None
    """The same for work done once per run."""
    import_ms: float | None
    """Import time of the part's modules. None: left out."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Study]:
    """Return the study of the report: each scene with its parts removed in sequence, down to the bare nodes."""
    from msgspec.structs import replace

    from tipforce.scene.schema import read_scene
    from tipforce_lab.scene_cost import measure, rungs

    series = []
    for name in SCENES:
        path = shipped_folder("scenes") / f"{name}.toml"
        scene = read_scene(path)
        # A plot takes longer than all other parts and does not grow with the samples.
        ladder = rungs(replace(scene, outputs=replace(scene.outputs, plot=None)))
        found = measure([scene for _, scene in ladder], path, effort.pick(100, 300), effort.pick(3, 7))
        settings = ["all parts", *(f"less {part}" for part, _ in ladder[:-1])]
        points = [
            Point(setting, one.P_rms_newtons, quartiles(one.seconds))
            for setting, one in zip(settings, found, strict=True)
        ]
        series.append(Series(name, tuple(points)))
        advance()
    whole, least = (one.points[0].timing.seconds for one in (series[1], series[0]))
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


def scene_costs(
    effort: Effort,
    advance: Callable[[], None] = lambda: None,
    scenes: Sequence[str] = SCENES,
    samples: int | None = None,
) -> list[SceneCost]:
    """Measure; return rows by scene, then by part in the order of `tipforce scene explain`."""
    from tipforce.scene.schema import read_scene
    from tipforce_lab.scene_cost import part_costs, total

    rows: list[SceneCost] = []
    for name in scenes:
        path = shipped_folder("scenes") / f"{name}.toml"
        scene = read_scene(path)
        costs = part_costs(scene, path, samples or effort.pick(100, 300), effort.pick(2, 5))
        rows += [
            SceneCost(name, one.part, one.built, one.us_per_sample, one.ms_per_run, one.import_ms) for one in costs
        ]
        whole = total(costs)
        rows.append(SceneCost(name, ALL, True, whole.us_per_sample, whole.ms_per_run, whole.import_ms))
        advance()
    return rows
