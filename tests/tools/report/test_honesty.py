"""What says ok and is wrong: the study counts it, and notices a judgement that is switched off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding import judged
from tipforce_lab.report.studies import honesty
from tipforce_lab.report.study import Counted

SECONDS = 3.0
NODE, FAULTS, DECODE, ESTIMATE, BARE = range(len(honesty.METHODS))


@pytest.fixture(scope="module")
def finger(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibration]:
    """Four gauges, calibrated by the command."""
    folder = tmp_path_factory.mktemp("finger")
    return folder, honesty.calibrated(folder, 4, np.random.default_rng(3))


def counts(finger: tuple[Path, Calibration], fault: str, seed: int = 1) -> list[Counted]:
    scene = honesty._scene(fault, 4, SECONDS, np.random.default_rng(seed))
    return honesty._counts(finger[0], scene, finger[1])


def test_a_good_finger_says_ok_and_is_right(finger: tuple[Path, Calibration]) -> None:
    for cell in counts(finger, "none"):
        assert cell.rows == 150
        assert cell.ok > 0.98 * cell.rows
        assert cell.wrong == 0


@pytest.mark.parametrize("fault", ["open", "saturate", "drift"])
def test_a_broken_gauge_is_no_longer_ok(finger: tuple[Path, Calibration], fault: str) -> None:
    before = honesty.FAULT_FROM * 150
    for cell in counts(finger, fault):
        assert 0.9 * before < cell.ok < 0.6 * cell.rows
        assert cell.wrong == 0


def test_silence_and_overload_are_not_ok(finger: tuple[Path, Calibration]) -> None:
    silent, overload = counts(finger, "silent"), counts(finger, "overload")
    assert silent[NODE].wrong == silent[DECODE].wrong == 0
    assert silent[ESTIMATE].wrong == silent[BARE].wrong == 0  # readings that repeat
    assert [overload[k].ok for k in (NODE, FAULTS, DECODE, ESTIMATE)] == [150, 0, 0, 0]


def test_a_judgement_that_is_switched_off_is_noticed(
    finger: tuple[Path, Calibration], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judged, "explained", lambda _W, shown, V, *_: (0.0 * V[0], [(0.0, 0.0)] * len(shown)))
    found = counts(finger, "drift")
    # The node judges by itself, and decode reads its status.
    assert found[NODE].wrong == found[FAULTS].wrong == found[DECODE].wrong == 0
    assert min(found[k].wrong for k in (ESTIMATE, BARE)) > 20
    row = honesty._row("drift", 5, tuple(found))
    assert row.over == (False, False, False, True, True)
    assert not row.held  # five gauges can tell: no reason excuses it
    assert honesty._row("drift", 3, tuple(found)).held


def test_remarks_count_what_the_table_has() -> None:
    rows = [
        honesty._row(fault, 5, (Counted(100, 90, wrong), *[Counted(100, 99, 0)] * 4))
        for fault, wrong in (("none", 0), ("warm", 8))
    ]
    told = honesty._remarks(rows)
    assert "contact PDO alone 8 of 180" in told[0]
    assert told[1] == f"Fewest: {honesty.METHODS[1]}."
    assert "97.2 %" in told[2]
    assert [row.held for row in rows] == [True, True]  # the contact PDO does not carry the temperature
