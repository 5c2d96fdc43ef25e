"""`tipforce doctor`: the checks of a machine and of a bus; each is one finding with its next step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "note", "fail"]
"""ok; note: works, with a remark; fail: the requested function will not work."""


@dataclass(frozen=True, slots=True)
class Check:
    """``next_step`` is a command or a sentence, "" if none is needed."""

    topic: str
    state: State
    finding: str
    next_step: str = ""
