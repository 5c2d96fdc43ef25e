"""What a report holds (studies with the timing of a method, grids, the recorded extreme cases) and its run, in which a
missing package or a failure is a line of the report, not its end."""

from __future__ import annotations

import importlib
import json
import platform
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from importlib import resources
from statistics import median, quantiles
from typing import Any, Literal

from tipforce.errors import EnvironmentLackError, InputError, TipforceError


@dataclass(frozen=True, slots=True)
class Effort:
    """Effort of a study: ``quick`` (all studies together within a minute) or full (ten minutes, two cores)."""

    quick: bool = False
    seed: int = 20261121

    def pick(self, quick: int, full: int) -> int:
        """Return the count for this effort."""
        return quick if self.quick else full


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds per unit of work: median, and first and third quartile (of the processor time where it is known)."""

    seconds: float
    first_quartile_s: float
    third_quartile_s: float
    runs: int
    cpu_seconds: float | None = None
    """Median processor time of the same runs: above ``seconds`` with several threads, below it where the work waits."""

    @property
    def work_seconds(self) -> float:
        """Processor time where it is known: other load on the machine does not change it."""
        return self.seconds if self.cpu_seconds is None else self.cpu_seconds


@dataclass(frozen=True, slots=True)
class Point:
    """One setting of one method: its error against the reference, and its time."""

    setting: str
    error: float
    timing: Timing
    rms_error: float | None = None
    """Root mean square, if ``error`` is the maximum."""


@dataclass(frozen=True, slots=True)
class Series:
    """One method, from coarse to fine. A method without a setting has one point."""

    method: str
    points: tuple[Point, ...]


def series_of(points: Iterable[tuple[str, Point]]) -> tuple[Series, ...]:
    """Return a series for each method of (method, point), in order."""
    by_method: dict[str, list[Point]] = {}
    for method, point in points:
        by_method.setdefault(method, []).append(point)
    return tuple(Series(method, tuple(of_method)) for method, of_method in by_method.items())


@dataclass(frozen=True, slots=True)
class Need:
    """What somebody wants to do, and the error that is small enough for it."""

    text: str
    enough: float
    """In the unit of the study's errors."""
    unit: str = ""
    """That unit: "N"; "" for a relative error."""
    unfit: tuple[str, ...] = ()
    """Methods that are not for it whatever their error here: a remark of one of the studies says why."""


@dataclass(frozen=True, slots=True)
class Study:
    """Methods for one task, side by side. Errors and times have one unit throughout the study."""

    key: str
    title: str
    error_unit: str
    """The kind of error, with its unit: "relative error of the condition number"."""
    work_unit: str
    """The unit of time: "s per load case"."""
    reference: str
    """The reference of the errors."""
    reference_error: float
    """The error of the reference itself, in the same unit: points below it are not significant."""
    series: tuple[Series, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    """Methods that did not run, with the reason and what to install."""
    remarks: tuple[str, ...] = ()
    """Conclusions, one sentence each, supported by these numbers."""
    needs: tuple[Need, ...] = ()
    """The needs that this study answers."""
    check: str = ""
    """An independent computation of the reference, where that is code of the project; "" for none."""
    check_difference: float | None = None
    """Largest difference of reference and check, in ``error_unit``."""

    def recommended(self, need: Need) -> tuple[Series, Point] | None:
        """Return the method and setting with the least time among those whose error is small enough; None: none is."""
        good = [
            (series, point)
            for series in self.series if series.method not in need.unfit
            for point in series.points if point.error <= need.enough
        ]  # fmt: skip
        return min(good, key=lambda pair: pair[1].timing.work_seconds, default=None)


def timed(work: Callable[[], object], effort: Effort, units: float = 1, at_least_s: float = 0.02) -> Timing:
    """Time ``work``, which does ``units`` units of work: several runs, each long enough for the clock."""
    return timed_together([work], effort, units, at_least_s)[0]


def timed_together(
    works: Sequence[Callable[[], object]],
    effort: Effort,
    units: float = 1,
    at_least_s: float = 0.02,
    warm: bool = False,
) -> list[Timing]:
    """Time several methods: each run calls all of them in turn, so that a change of the machine's load meets all alike.
    One call of each goes first, untimed, unless the works are ``warm``; a run repeats a call for ``at_least_s``."""
    repeats = []
    for work in works:
        if not warm:
            work()
        count = 1
        while (elapsed_s := _elapsed(work, count)[0]) < at_least_s:
            count = max(count * 2, int(count * at_least_s / max(elapsed_s, 1e-9)))
        repeats.append(count)
    jobs = list(zip(works, repeats, strict=True))
    runs = [[_elapsed(work, count) for work, count in jobs] for _ in range(effort.pick(3, 7))]
    timings = []
    for count, elapsed in zip(repeats, zip(*runs, strict=True), strict=True):
        wall_s, cpu_s = ([seconds / (count * units) for seconds in column] for column in zip(*elapsed, strict=True))
        timings.append(quartiles(wall_s, cpu_s))
    return timings


def quartiles(seconds: Sequence[float], cpu_seconds: Sequence[float] | None = None) -> Timing:
    """Return the timing of several runs, at least two, per unit of work."""
    first, middle, third = quantiles(seconds if cpu_seconds is None else cpu_seconds, n=4, method="inclusive")
    return Timing(median(seconds), first, third, len(seconds), None if cpu_seconds is None else middle)


def _elapsed(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    started, started_cpu = time.perf_counter_ns(), time.process_time_ns()
    for _ in range(repeats):
        work()
    return (time.perf_counter_ns() - started) * 1e-9, (time.process_time_ns() - started_cpu) * 1e-9


@dataclass(frozen=True, slots=True)
class Counted:
    """Rows of one case by one method: all, those that say ok, and those of them that are wrong."""

    rows: int = 0
    ok: int = 0
    wrong: int = 0

    def __add__(self, other: Counted) -> Counted:
        return Counted(self.rows + other.rows, self.ok + other.ok, self.wrong + other.wrong)


@dataclass(frozen=True, slots=True)
class GridRow:
    """One case by every method."""

    name: str
    cells: tuple[Counted, ...]
    reasons: tuple[str, ...]
    """For each method: why the data cannot tell where too many rows are wrong, or ""."""
    over: tuple[bool, ...]
    """For each method: more rows are wrong than allowed."""

    @property
    def held(self) -> bool:
        """No method has too many wrong rows without a known reason."""
        return all(reason or not over for reason, over in zip(self.reasons, self.over, strict=True))


@dataclass(frozen=True, slots=True)
class Grid:
    """Cases by methods: how often each says ok and is wrong."""

    key: str
    title: str
    corner: str
    methods: tuple[str, ...]
    rows: tuple[GridRow, ...]
    remarks: tuple[str, ...] = ()


def sums_of(methods: Sequence[str], rows: Iterable[GridRow]) -> tuple[dict[str, Counted], str]:
    """Return all rows by method, and the method that shows the fewest wrong ones as ok."""
    columns = zip(*(row.cells for row in rows), strict=True)
    sums = {name: sum(column, Counted()) for name, column in zip(methods, columns, strict=True)}
    return sums, min(sums, key=lambda name: (sums[name].wrong, -sums[name].ok))


Outcome = Literal["pass", "bounded", "flagged", "refused"]
"""pass: the result is right to rounding. bounded: its error has a stated bound. flagged: the value is marked (NaN,
unknown, a status bit, EMCY). refused: an error or abort code names the place, and nothing changed."""


@dataclass(frozen=True, slots=True)
class Case:
    """An extreme case, as the tests recorded it."""

    key: str
    """"area.what", unique: "contact.denormal_load"."""
    situation: str
    """The extreme input, with its numbers."""
    outcome: Outcome
    claim: str
    """One sentence."""
    held: bool
    figures: str
    """What the test observed, one line."""


def all_cases() -> list[Case]:
    """Return every recorded case, in the order of the report."""
    lines = resources.files(__package__).joinpath("cases.jsonl").read_text(encoding="utf-8").splitlines()
    return [Case(**json.loads(line)) for line in lines]


STUDIES: dict[str, tuple[str, str]] = {
    "structure": ("tipforce_lab.report.studies.structure", "structure models: beams, frame, finite elements"),
    "integrators": ("tipforce_lab.report.studies.integrators", "integrators: smooth load, step, tap, stiff impact"),
    "estimators": ("tipforce_lab.report.studies.estimators", "arithmetic of the estimator"),
    "fits": ("tipforce_lab.report.studies.fits", "calibration fits against the number of loads"),
    "decoders": ("tipforce_lab.report.studies.decoders", "decoders of CAN frames"),
    "honesty": ("tipforce_lab.report.studies.honesty", "wrong values shown as ok: every fault by every method"),
    "scenes": ("tipforce_lab.scene_cost", "cost of each part of a scene"),
}
"""Key -> (module with STEPS and studies(effort, advance), subject)."""
STABILITY = "stability"
_EXTRAS, _ALL = {"scipy": "science", "matplotlib": "plot", "skfem": "fem"}, '"tipforce[report]"'
_VERSIONS = ("numpy", "scipy", "scikit-fem", "matplotlib", "python-can", "canopen", "cantools")

Advance = Callable[[], None]


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A part that did not run; ``failed``: because of a fault, not a missing package."""

    key: str
    reason: str
    failed: bool


Item = Study | Grid | Case | LeftOut


@dataclass(slots=True)
class Report:
    """The content of a report."""

    date: str
    effort: Effort
    machine: dict[str, str]
    studies: list[Study] = field(default_factory=list)
    grids: list[Grid] = field(default_factory=list)
    cases: list[Case] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)

    def sound(self) -> bool:
        """Whether every claim held and nothing failed; parts left out for a missing package do not count."""
        return (
            all(case.held for case in self.cases)
            and all(row.held for grid in self.grids for row in grid.rows)
            and not any(lack.failed for lack in self.left_out)
        )


def selected(only: str | None) -> tuple[list[str], list[Case]]:
    """Return keys of STUDIES, and cases. ``only``: study keys, "stability", case keys, areas of cases and patterns of
    them, with commas; None for all. Raises InputError for an unknown word."""
    known = all_cases()
    if only is None:
        return list(STUDIES), known
    words = [word for word in (part.strip() for part in only.split(",")) if word] or [only]
    keys, chosen = [key for key in STUDIES if key in words], set[str]()
    for word in (word for word in words if word not in keys):
        patterns = ("*",) if word == STABILITY else (word, f"{word}.*")
        fitting = {case.key for case in known if any(fnmatchcase(case.key, pattern) for pattern in patterns)}
        if word != STABILITY and not fitting:
            allowed = f"allowed are {', '.join([*STUDIES, STABILITY])} and the cases of --list"
            raise InputError(f"--only {word!r}: {allowed}")
        chosen |= fitting
    return keys, [case for case in known if case.key in chosen]


class Run:
    """One run: first the list of steps (the length of the progress bar), then ``report``."""

    def __init__(self, selection: tuple[list[str], list[Case]], effort: Effort, date: str) -> None:
        keys, self._cases = selection
        self.report = Report(date, effort, machine())
        modules = {key: self._guarded(key, partial(importlib.import_module, STUDIES[key][0])) for key in keys}
        self._modules = {key: module for key, module in modules.items() if module is not None}
        self.steps = sum(int(module.STEPS) for module in self._modules.values()) + len(self._cases)

    def items(self, advance: Advance) -> Iterator[Item]:
        """Run all; yield each study and case when done. The studies run first and alone, because they are timed."""
        report = self.report
        yield from report.left_out
        for key, module in self._modules.items():
            results = self._guarded(key, partial(module.studies, report.effort, advance))
            if results is None:
                yield report.left_out[-1]
                continue
            report.studies += [result for result in results if isinstance(result, Study)]
            report.grids += [result for result in results if isinstance(result, Grid)]
            yield from results
        for case in self._cases:
            report.cases.append(case)
            yield case
            advance()

    def _guarded(self, key: str, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except ModuleNotFoundError as error:
            name = (error.name or "").split(".")[0]
            hint = f'"tipforce[{_EXTRAS[name]}]", or "tipforce[report]" for all' if name in _EXTRAS else _ALL
            lack = LeftOut(key, f"{name} is not installed: pip install {hint}", False)
            if name in ("tipforce", "tipforce_lab"):
                lack = LeftOut(key, f"not part of this installation ({error.name})", True)
        except TipforceError as error:
            lack = LeftOut(key, str(error), not isinstance(error, EnvironmentLackError))
        except Exception as error:  # a fault in one study must not end the others
            last = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{last.name}(), line {last.lineno} of {last.filename.rsplit('/')[-1]}"
            lack = LeftOut(key, f"{type(error).__name__} in {place}: {error}", True)
        self.report.left_out.append(lack)
        return None


def machine() -> dict[str, str]:
    """Return what the times depend on: processor, system, versions."""
    import os
    from importlib.metadata import PackageNotFoundError, version

    from tipforce.dictionary.table import SOFTWARE_VERSION

    try:  # platform.processor() is often empty on Linux
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    facts = {
        "processor": f"{name}, {os.cpu_count()} threads",
        "system": f"{platform.system()} {platform.machine()}",
        "Python": f"{platform.python_implementation()} {platform.python_version()}",
        "tipforce": SOFTWARE_VERSION,
    }
    for package in _VERSIONS:
        try:
            facts[package] = version(package)
        except PackageNotFoundError:
            facts[package] = "not installed"
    return facts
