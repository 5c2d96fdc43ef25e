"""How the benchmark's master steers the processes that it measures, and what they note of themselves."""

from __future__ import annotations

import time

STOP_ID, MARK_ID = 0x7FF, 0x7FE  # the master ends a process, or has it note its CPU time


class Stopped(Exception):  # noqa: N818
    """The master is done."""


class Usage:
    """CPU time of a process between two marks."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, float]] = []

    def control(self, can_id: int) -> None:
        """Act on a control frame."""
        if can_id == MARK_ID:
            self._marks.append((time.process_time(), time.perf_counter()))
        elif can_id == STOP_ID:
            raise Stopped

    @property
    def share(self) -> float:
        """CPU time over wall time; 0 without two marks."""
        if len(self._marks) < 2:
            return 0.0
        (cpu_0, wall_0), (cpu_1, wall_1) = self._marks[0], self._marks[-1]
        return (cpu_1 - cpu_0) / (wall_1 - wall_0)
