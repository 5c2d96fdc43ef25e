"""The extreme cases: the record of the tests in ``tests/stability``, which the report shows."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from typing import Literal

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
