"""The histogram of SYNC periods against numpy on all of them; the thread that keeps its times."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from tipforce.errors import EnvironmentLackError
from tipforce.host.hand.link import Jitter, ThreadSync


@pytest.mark.parametrize("nominal_ns", [1_000_000, 0])
def test_percentiles_are_those_of_the_deviations(nominal_ns: int) -> None:
    generator = np.random.default_rng(5)
    times = np.cumsum(1_000_000 + generator.normal(0, 20_000, 5000).astype(np.int64))
    jitter = Jitter(nominal_ns)
    for block in np.array_split(times, 37):
        jitter.add(block.tolist())
    jitter.add([])
    periods = np.diff(times)
    deviations = np.abs(periods - (nominal_ns or np.median(periods[:136]))) / 1e3
    found = jitter.figures()
    assert found.periods == len(periods)
    assert found.mean_period_us == pytest.approx(periods.mean() / 1e3)
    assert found.largest_us == pytest.approx(deviations.max(), abs=1.0)
    assert found.p50_us == pytest.approx(np.percentile(deviations, 50), abs=2.0)
    assert found.p99_us == pytest.approx(np.percentile(deviations, 99), abs=3.0)


def test_an_interruption_is_no_jitter_and_a_gap_is() -> None:
    jitter = Jitter(1000)
    jitter.add([0, 1000])
    jitter.skip()
    jitter.add([900_000_000])
    jitter.add([900_001_000, 980_001_000])
    found = jitter.figures()
    assert (found.periods, found.largest_us) == (3, 79_999.0)
    assert np.isnan(Jitter().figures().p50_us)


def test_the_thread_sends_as_many_as_it_should() -> None:
    enough = threading.Event()
    sent = []

    def send(_data: bytes) -> None:
        sent.append(0)
        if len(sent) == 20:
            enough.set()

    sync = ThreadSync(send, 0.002)
    assert enough.wait(10)
    sync.stop()
    count = len(sent)
    enough.clear()
    assert not enough.wait(0.02)
    assert len(sent) == count


def test_a_bus_that_refuses_ends_it_and_a_slow_one_loses_syncs() -> None:
    calls: list[float] = []

    def slow(_data: bytes) -> None:
        calls.append(time.monotonic())
        time.sleep(0.05)
        if len(calls) == 4:
            raise EnvironmentLackError("no bus")

    sync = ThreadSync(slow, 0.005)
    sync._thread.join(60)
    sync.stop()
    assert len(calls) == 4
    assert np.diff(calls).min() >= 0.05  # two close together leave no time for the first
