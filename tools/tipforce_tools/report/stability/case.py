"""One extreme case: what is done, what is promised, and what was seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from tipforce.errors import InputError

Outcome = Literal["pass", "bounded", "flagged", "refused"]
"""pass: the answer is right to rounding. bounded: its error has a stated bound. flagged: the value is marked (NaN,
unknown, a status bit, EMCY). refused: an error or abort code names the place, and nothing changed."""


@dataclass(frozen=True, slots=True)
class Observed:
    """What a check saw: which outcomes occurred (in order), one line of figures, and whether the claim held."""

    held: bool
    figures: str


@dataclass(frozen=True, slots=True)
class Case:
    """An extreme case. ``check`` runs it and judges ``claim``; it must be able to fail."""

    key: str
    """"area.what", unique: "contact.denormal_load"."""
    situation: str
    """What is extreme, with its numbers."""
    outcome: Outcome
    claim: str
    """What is promised, one sentence that ``check`` decides."""
    check: Callable[[], Observed]


def refusal(act: Callable[[], object]) -> str:
    """The text of the InputError that an action raises; empty where it raises none."""
    try:
        act()
    except InputError as error:
        return str(error)
    return ""
