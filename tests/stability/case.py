"""Extreme cases: input, claim and observation; run as a program it writes the record that `tipforce report` shows."""

import importlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeAlias, cast

import numpy as np

from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import State
from tipforce.sensor.dynamics.model import Modes
from tipforce_lab.report.study import Outcome

_PLAIN = (
    (r"(?<![\w\])])\[([^\[\]]*)\]", r"\1"),  # lists, but not the indices of strain[17, 1]
    (r"\{([^{}]*)\}", r"\1"),
    (r"(?<![\w])\((-?[\w.]+(?:, -?[\w.]+)*),?\)", r"\1"),  # tuples, but not remarks of several words
    (r"'([^'\s]*)'", r"\1"),
    (r"\bTrue\b", "yes"), (r"\bFalse\b", "no"), (r"\bNone\b", "none"),
    (r"\bnan\b", "NaN"), (r"(?<![\w/])inf\b", "infinity"), (r"\b0\.0e\+00\b", "0"),
)  # fmt: skip


Observed: TypeAlias = tuple[bool, str]
"""Whether the claim of a case held, and one line of figures."""


@dataclass(frozen=True, slots=True)
class Case:
    """An extreme case: a function of an area whose docstring is "the extreme input -> outcome: the claim"."""

    key: str
    """"area.what", the name of the function: "contact.denormal_load"."""
    situation: str
    outcome: Outcome
    claim: str
    check: Callable[[], Observed]
    """Runs the case and tests the claim; it must be able to fail."""


def cases_of(area: ModuleType) -> list[Case]:
    """Return the cases of a module, its public functions, in their order."""
    found = []
    for name, check in vars(area).items():
        if isinstance(check, FunctionType) and check.__module__ == area.__name__ and not name.startswith("_"):
            situation, _, rest = " ".join((check.__doc__ or "").split()).partition(" -> ")
            outcome, _, claim = rest.partition(": ")
            what = name.removeprefix("front_end_")
            key = f"front_end.{what}" if what != name else name.replace("_", ".", 1)
            found.append(Case(key, situation, cast("Outcome", outcome), claim, check))
    return found


def energy(modes: Modes, state: State) -> float:
    """Return the energy of motion and of the bent beams in joules."""
    return 0.5 * float(np.sum((state.position / modes.omega_rad_s) ** 2 + (state.velocity / modes.omega_rad_s) ** 2))


def refusal(act: Callable[..., object], *arguments: Any, kind: type[Exception] = InputError, **named: Any) -> str:
    """Return the text of the error of a kind that a call raises; empty if it raises none."""
    try:
        act(*arguments, **named)
    except kind as error:
        return str(error)
    return ""


def plain(figures: str) -> str:
    """Return figures without Python's brackets, quotes and names of values."""
    for pattern, words in _PLAIN:
        figures = re.sub(pattern, words, figures)
    return figures


def shortened(text: str, length: int = 120) -> str:
    """Return the beginning of a message, up to the end of a word."""
    if len(text) <= length:
        return text
    return text[: text.rindex(" ", 0, length)].rstrip(" ,;:(") + " ..."


AREAS = (
    "contact", "uncertainty", "layout", "gauges", "filters", "calibration", "fit", "wire", "clock", "dynamics",
    "impact",
)  # fmt: skip
"""Modules of this folder, in the order of the report."""
RECORD = Path(__file__).parents[2] / "tools" / "tipforce_lab" / "report" / "cases.jsonl"


def cases() -> list[Case]:
    return [case for area in AREAS for case in cases_of(importlib.import_module(f"stability.{area}"))]


def recorded(case: Case, observed: Observed) -> dict[str, object]:
    """Return the record of one case, as ``tipforce_lab.report.study.Case`` reads it."""
    names = ("key", "situation", "outcome", "claim")
    held, figures = observed
    # numpy's bool is not a bool of JSON.
    return {name: getattr(case, name) for name in names} | {"held": bool(held), "figures": plain(figures)}


if __name__ == "__main__":
    RECORD.write_text("".join(json.dumps(recorded(case, case.check())) + "\n" for case in cases()), encoding="utf-8")
