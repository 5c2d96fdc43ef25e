"""Reports made for the tests: two studies and cases of every outcome, in modules that stand in for the real ones."""

import sys
import types
from collections.abc import Callable

import pytest

from tipforce_lab.report.study import Case, Counted, Effort, Grid, GridRow, Need, Outcome, Point, Series, Study, Timing

TIMING = Timing(2e-6, 1e-6, 4e-6, 7)


class Tiny(Effort):
    """Less than quick: what a test can wait for."""

    def pick(self, quick: int, full: int) -> int:
        return max(2, min(quick, full) // 8)


def at_once(work: Callable[[], object], _effort: Effort, units: int = 1, at_least_s: float = 0.0) -> Timing:
    """In place of ``timed``: one call, no clock."""
    work()
    return Timing(1e-6 / units + at_least_s, 0.9e-6 / units, 1.1e-6 / units, 2)


def study(key: str, reference_error: float = 1e-9) -> Study:
    """Three methods: one with a setting to turn, one with a root mean square, one that is exact at times."""
    fine = tuple(Point(f"{n} <cells>", 10.0**-n, Timing(n * 1e-5, n * 0.8e-5, n * 1.3e-5, 7)) for n in (1, 2, 3))
    return Study(
        key=key,
        title=f"Study {key} & more",
        error_unit="largest error (1 < 2)",
        work_unit="s per sample",
        reference="what is known <exactly>",
        reference_error=reference_error,
        series=(
            Series("turned", fine),
            Series("with \"rms\" & 'quotes'", (Point("", 1e-4, TIMING, 1e-5),)),
            Series("exact", (Point("", 0.0, TIMING),)),
        ),
        left_out={"absent": "needs <something>"},
        remarks=("a remark & its reason",),
        needs=(Need("1 < 2, nearly", 1e-2), Need("the impossible", 0.0, unfit=("exact",))),
        check="<another> way",
        check_difference=3e-12,
    )


def grid(held: bool = True) -> Grid:
    """Two methods, one of which shows wrong rows: with a reason, or without one."""
    counts = (Counted(100, 90, 0), Counted(100, 80, 7))
    row = GridRow("drift, <3>", counts, ("", "none is spare & so" if held else ""), (False, True))
    return Grid("ok", "What says <ok>", "fault", ("one", "two"), (row,), ("a remark",))


def cases() -> list[Case]:
    """One of each outcome, and two that do not hold."""
    outcomes: tuple[Outcome, ...] = ("pass", "bounded", "flagged", "refused")
    held = [Case(f"area.{what}", f"load < 1e-300 N ({what})", what, "it is <said>", True, "0 & 1") for what in outcomes]
    return [
        *held,
        Case("other.wrong", "a wrong value", "flagged", "it is marked", False, "it was not"),
        Case("other.broken", "a broken check", "pass", "it runs", False, "the check itself failed: ZeroDivisionError"),
    ]


def module(studies: Callable[[Effort, Callable[[], None]], list[Study]], steps: int = 1) -> types.ModuleType:
    made = types.ModuleType("made")
    made.STEPS = steps  # type: ignore[attr-defined]
    made.studies = studies  # type: ignore[attr-defined]
    return made


def install(monkeypatch: pytest.MonkeyPatch, modules: dict[str, types.ModuleType], with_cases: bool = True) -> None:
    for key, made in modules.items():
        monkeypatch.setitem(sys.modules, f"made_{key}", made)
    monkeypatch.setattr("tipforce_lab.report.study.STUDIES", {key: (f"made_{key}", f"about {key}") for key in modules})
    monkeypatch.setattr("tipforce_lab.report.study.all_cases", cases if with_cases else list)
