"""A seeded part of `python -m bench.soak`, and that its check can fail."""

from __future__ import annotations

import pytest
from bench.soak import Soak
from bench.soak_fingers import stored_fingers

from tipforce.host.hand.collector import Collector
from tipforce.host.network.faulty_bus import Faults


def test_a_minute_of_trouble_breaks_nothing() -> None:
    outcome = Soak(stored_fingers(3, 7), seed=7).run(40.0)
    assert outcome.breaks == []
    assert outcome.checked > 5000
    assert outcome.counts["boot_up"] > 0
    assert outcome.counts["frames: delay"] > 0


def test_without_faults_nothing_is_missing() -> None:
    soak = Soak(stored_fingers(2, 8), seed=8, faults=Faults())
    for tick in range(300):
        soak._tick(tick * 0.01)
        soak._trouble_s = 0.0
    assert soak.outcome.breaks == []


def test_a_value_in_another_row_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    faults = Faults(drop=0.05, delay=0.2, delay_s=0.025)
    fingers = stored_fingers(3, 7)
    assert Soak(fingers, seed=7, faults=faults).run(20.0).breaks == []
    monkeypatch.setattr(Collector, "_row_of", lambda self, _counter, _number: self._last)
    assert Soak(stored_fingers(3, 7), seed=7, faults=faults).run(20.0).breaks
