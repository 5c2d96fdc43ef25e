"""The report's study of structure models: complete, honest about its reference, and without scikit-fem."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from tipforce_lab.report.studies import structure
from tipforce_lab.report.study import Effort, Study, Timing


@pytest.fixture(scope="module")
def found() -> tuple[dict[str, Study], int]:
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(structure, "timed", _once)
        studies = structure.studies(Effort(quick=True), lambda: steps.append(1))
    return {one.key: one for one in studies}, len(steps)


def _once(work: object, _: Effort) -> Timing:
    assert callable(work)
    work()
    return Timing(1.0, 1.0, 1.0, 1)


def test_models_and_their_errors(found: tuple[dict[str, Study], int]) -> None:
    study = found[0]["structure-condition"]
    errors = {one.method: [point.error for point in one.points] for one in study.series}
    assert study.reference_error < 2e-3
    assert errors["Table 1, at its points"][0] == pytest.approx(0.12, abs=0.01)
    # The frame without shear and root springs is Table 1 in another place of the code.
    assert errors["frame, Euler-Bernoulli"] == pytest.approx(errors["Table 1, where 1 mm gauges fit"], rel=1e-9)
    assert errors["frame, roots that rotate"] < errors["frame, Timoshenko"] < errors["frame, Euler-Bernoulli"]
    graded, uniform = errors["FE, graded meshes"], errors["FE, uniform meshes"]
    assert graded[-1] < 0.5 * uniform[-1]
    assert (np.diff(graded) < 0.0).all()
    assert all("infinite" not in remark and "nan" not in remark for remark in study.remarks)
    assert "3.078" in study.reference


def test_without_scikit_fem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    steps: list[int] = []
    studies = structure.studies(Effort(quick=True), lambda: steps.append(1))
    assert len(steps) == structure.STEPS
    for study in studies:
        assert not study.series
        assert any('pip install "tipforce[fem]"' in reason for reason in study.left_out.values())
