"""The study of calibration fits: offsets and outliers cost what theory says they cost."""

from __future__ import annotations

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce_lab.report.studies import fits
from tipforce_lab.report.study import Study
from tools.report.made import Tiny, at_once


@pytest.fixture(scope="module")
def found() -> dict[str, Study]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fits, "timed", at_once)
        patch.setattr(fits, "LOADS", (12, 50, 200))
        patch.setattr(Tiny, "pick", lambda *_: 5)
        return {one.key: one for one in fits.studies(Tiny(), lambda: None)}


def errors(study: Study) -> dict[str, np.ndarray]:
    return {one.method: np.array([point.error for point in one.points]) for one in study.series}


def test_the_error_falls_with_the_root_of_the_number_of_loads(found: dict[str, Study]) -> None:
    full = errors(found["fits"])[fits.FULL]
    assert (np.diff(full) < 0.0).all()
    assert np.polyfit(np.log([50, 200]), np.log(full[1:]), 1)[0] == pytest.approx(-0.5, abs=0.25)


def test_without_an_offset_more_loads_do_not_help(found: dict[str, Study]) -> None:
    clean = errors(found["fits"])
    assert clean[fits.LINEAR][-1] > 50.0 * clean[fits.FULL][-1]
    assert clean[fits.LINEAR][-1] > 0.5 * clean[fits.LINEAR][0]


def test_least_squares_are_as_good_until_there_are_outliers(found: dict[str, Study]) -> None:
    clean, odd = errors(found["fits"]), errors(found["fits-outliers"])
    assert clean[fits.AFFINE] == pytest.approx(clean[fits.FULL], rel=0.1)
    assert odd[fits.AFFINE][-1] > 5.0 * odd[fits.FULL][-1]
    assert odd[fits.FULL][-1] < 1.5 * clean[fits.FULL][-1]


def test_a_refusal_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(_rig: object) -> fits.Fitted:
        raise InputError("too few rows")

    monkeypatch.setattr(fits, "timed", at_once)
    monkeypatch.setattr(fits, "LOADS", (6,))
    monkeypatch.setitem(fits._METHODS, fits.FULL, refusing)
    for one in fits.studies(Tiny(), lambda: None):
        assert one.left_out == {f"{fits.FULL}, 6 loads": "refused: too few rows"}
        assert fits.FULL not in [series.method for series in one.series]
