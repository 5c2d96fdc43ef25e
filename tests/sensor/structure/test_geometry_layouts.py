"""What a geometry and a layout accept, and what they say about the rest."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import pytest

from tipforce.errors import InputError
from tipforce.sensor.structure.geometry import FABRICATED, THIN_BEAM_RATIO
from tipforce.sensor.structure.layouts import LAYOUTS, POINTS, layout, layout_code, mirror


def test_geometry_is_frozen_and_has_a_thin_limit() -> None:
    with pytest.raises(FrozenInstanceError):
        FABRICATED.a_m = 1.0  # type: ignore[misc]
    thin = FABRICATED.thin(1e-6)
    assert thin.h2_m == THIN_BEAM_RATIO * 1e-6
    assert replace(thin, h1_m=FABRICATED.h1_m, h2_m=FABRICATED.h2_m) == FABRICATED
    with pytest.raises(InputError, match="h1_m"):
        FABRICATED.thin(0.0)


def test_named_layouts_and_their_mirrors() -> None:
    for name in ("I", "II", "III"):
        assert layout(name) == LAYOUTS[name]
        assert mirror(name) == layout(name + "'")
        assert mirror(mirror(name)) == layout(name)


@pytest.mark.parametrize(
    ("gauges", "code"),
    [("I", 1), ("II", 2), ("III", 3), ("I'", 255), (["L", "R", "U"], 3), (["U", "R", "L"], 255), (POINTS, 255)],
)
def test_layout_codes(gauges: str | list[str], code: int) -> None:
    assert layout_code(gauges) == code


@pytest.mark.parametrize(
    ("gauges", "message"),
    [
        ("IV", "layout 'IV' is not known: allowed are I, II, III, I', II', III'"),
        (("L", "R", "X"), "gauge point 'X' is not known: allowed are L, R, T, U, K_H, S_H, K_V, S_V"),
        (("L", "R"), "a layout of 2 gauge points: allowed are 3 to 8"),
        (("L", "R", "U", "R"), "gauge point R is given more than once"),
        ((*POINTS, "L"), "a layout of 9 gauge points: allowed are 3 to 8"),
    ],
)
def test_layout_refuses(gauges: str | tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError) as error:
        layout(gauges)
    assert message in str(error.value)
