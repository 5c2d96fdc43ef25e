"""Structure and anti-alias filter as one system, sampled at times that need not fit the load's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tipforce.errors import InputError
from tipforce.sensor.dynamics.first_order_hold import respond
from tipforce.sensor.dynamics.model import modes
from tipforce.sensor.structure.geometry import FABRICATED
from tipforce_lab.dynamics.sampling import AntiAlias, sampled

BODY = modes(FABRICATED, 0.01)
F = np.array([1.0, 0.5, -0.3])


def noise(m: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.random.default_rng(5).uniform(-1.0, 1.0, (m, 3))


def test_without_filter_it_is_the_held_response() -> None:
    loads = noise(201)
    wanted = respond(BODY, loads, 5e-4).elastic_newtons
    np.testing.assert_allclose(sampled(BODY, None, loads, 500, 1000), wanted[::2], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(sampled(None, None, loads, 500, 500), loads, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("with_structure", [False, True])
def test_the_steps_of_the_load_do_not_matter(order: int, with_structure: bool) -> None:
    coarse = noise(21)
    fine = np.stack([np.interp(np.arange(0, 60001), np.arange(21) * 3000, column) for column in coarse.T], axis=1)[
        ::300
    ]
    body = BODY if with_structure else None
    a, b = (sampled(body, AntiAlias(200.0, order), loads, step, 700) for loads, step in ((coarse, 3000), (fine, 300)))
    np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_the_filter_answers_a_step_as_its_closed_form(order: int) -> None:
    t = np.arange(0, 20001, 500) * 1e-6
    w = 2.0 * math.pi * 100.0
    found = sampled(None, AntiAlias(100.0, order), np.tile(F, (21, 1)), 1000, 500)
    turn = w * t / math.sqrt(2.0)
    rise = 1.0 - np.exp(-w * t) if order == 1 else 1.0 - np.exp(-turn) * (np.cos(turn) + np.sin(turn))
    np.testing.assert_allclose(found, np.outer(rise, F), rtol=0.0, atol=1e-13)


@pytest.mark.parametrize(("order", "decade"), [(1, 0.0995), (2, 0.0100)])
def test_gain_at_and_above_the_cutoff(order: int, decade: float) -> None:
    for frequency, wanted in ((100.0, math.sqrt(0.5)), (1000.0, decade)):
        t = np.arange(0, 200_001, 20) * 1e-6
        loads = np.outer(np.sin(2.0 * math.pi * frequency * t), [1.0, 0.0, 0.0])
        found = sampled(None, AntiAlias(100.0, order), loads, 20, 20)[-501:, 0]
        phase = 2.0 * math.pi * frequency * t[-501:]
        gain = math.hypot(
            2.0 * np.mean(found[:-1] * np.sin(phase[:-1])), 2.0 * np.mean(found[:-1] * np.cos(phase[:-1]))
        )
        assert gain == pytest.approx(wanted, rel=5e-3)


def test_settled_stands_still() -> None:
    for body in (None, BODY):
        for anti_alias in (None, AntiAlias(300.0), AntiAlias(300.0, 2)):
            found = sampled(body, anti_alias, np.tile(F, (30, 1)), 1000, 250, settled=True)
            np.testing.assert_allclose(found, np.tile(F, (117, 1)), rtol=0.0, atol=1e-12)


def test_what_is_refused() -> None:
    with pytest.raises(InputError, match="cutoff_hz"):
        AntiAlias(0.0)
    with pytest.raises(InputError, match="order"):
        AntiAlias(1.0, 3)
    with pytest.raises(InputError, match="period_us"):
        sampled(BODY, None, np.zeros((2, 3)), 500, 0)
    with pytest.raises(InputError, match="finite"):
        sampled(BODY, None, np.full((2, 3), math.nan), 500, 500)
