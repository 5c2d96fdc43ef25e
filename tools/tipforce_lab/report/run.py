"""Run the studies and read the extreme cases. A missing package or a failure is a line in the report, not its end."""

import importlib
import platform
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from typing import Any

from tipforce.errors import EnvironmentLackError, InputError, TipforceError
from tipforce_lab.report.study import Case, Effort, Grid, Study, all_cases

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
