"""Error against run time: the data of a study, and the timing of a method."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from statistics import quantiles


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
    """Seconds per unit of work: the median of several runs, and the first and third quartile."""

    seconds: float
    first_quartile_s: float
    third_quartile_s: float
    runs: int


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


def timed(work: Callable[[], object], effort: Effort, units: int = 1, at_least_s: float = 0.02) -> Timing:
    """Time ``work``, which does ``units`` units of work: several runs, each long enough for the clock.

    One call goes first, untimed. A run repeats the call until it has taken ``at_least_s``.
    """
    work()
    repeats = 1
    while True:
        elapsed_s = _elapsed(work, repeats)
        if elapsed_s >= at_least_s:
            break
        repeats = max(repeats * 2, int(repeats * at_least_s / max(elapsed_s, 1e-9)))
    runs = effort.pick(3, 7)
    return quartiles([_elapsed(work, repeats) / (repeats * units) for _ in range(runs)])


def quartiles(seconds: Sequence[float]) -> Timing:
    """Return the timing of several runs, at least two, per unit of work."""
    first, median, third = quantiles(seconds, n=4, method="inclusive")
    return Timing(median, first, third, len(seconds))


def _elapsed(work: Callable[[], object], repeats: int) -> float:
    started = time.perf_counter_ns()
    for _ in range(repeats):
        work()
    return (time.perf_counter_ns() - started) * 1e-9
