"""One finding of `tipforce doctor`: what was looked at, how it is, and what to do next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "note", "fail"]
"""ok; note: works, but look at it; fail: what was asked for will not work."""


@dataclass(frozen=True, slots=True)
class Check:
    """``next_step`` is a command or a sentence, "" where nothing is to do."""

    topic: str
    state: State
    finding: str
    next_step: str = ""
