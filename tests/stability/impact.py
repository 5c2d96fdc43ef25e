"""Extreme impacts: contact stiffnesses from 1e5 to 1e8, light and heavy bodies, a slit that closes."""

import math

import numpy as np

from stability.case import Observed, energy, refusal
from tipforce.sensor.dynamics.model import Modes, modes
from tipforce.sensor.structure.plane_frame import closing_load
from tipforce.sensor.structure.strain import FABRICATED
from tipforce_lab.dynamics import integrators
from tipforce_lab.dynamics.impact import Impact, Striker, impact, overload
from tipforce_lab.dynamics.switched import slit_stop

_STIFFNESSES = (1e5, 1e6, 1e7, 1e8)
_MASS_KG, _SPEED = 0.02, 0.1


def _off(striker: Striker, peak_newtons: float, duration_s: float) -> float:
    """Return the largest relative error of peak, duration and rebound speed of one touch on rigid ground."""
    found = impact(None, striker, 2.0 * duration_s)
    (touch,) = found.touches
    return max(abs(touch.peak_newtons / peak_newtons - 1.0),
               abs((touch.end_s - touch.begin_s) / duration_s - 1.0),
               abs(found.body_speed_m_s / -striker.speed_m_s - 1.0))  # fmt: skip


def impact_linear_rigid() -> Observed:
    """linear contact of 1e5 to 1e8 N/m on rigid ground, 1 mg to 100 kg -> pass: peak v sqrt(k m), duration pi sqrt(m /
    k) and rebound speed v within 1e-12"""
    worst = 0.0
    for k in _STIFFNESSES:
        for m in (1e-6, 1e-3, 1.0, 100.0):
            peak, duration = _SPEED * math.sqrt(k * m), math.pi * math.sqrt(m / k)
            worst = max(worst, _off(Striker(m, _SPEED, k), peak, duration))
    return worst <= 1e-12, f"16 impacts, largest relative error {worst:.1e}"


def impact_hertz_rigid() -> Observed:
    """Hertzian contact of 1e5 to 1e8 N/m^1.5 on rigid ground, 1 g and 1 kg -> pass: peak, duration and rebound speed
    equal the closed form within 1e-11"""
    worst = 0.0
    for k in _STIFFNESSES:
        for m in (1e-3, 1.0):
            deepest = (1.25 * m * _SPEED**2 / k) ** 0.4
            # 2 x deepest / v times the integral of 1 / sqrt(1 - x^2.5) from 0 to 1.
            duration = 2.0 * deepest / _SPEED * math.sqrt(math.pi) * math.gamma(1.4) / math.gamma(0.9)
            worst = max(worst, _off(Striker(m, _SPEED, k, 1.5), k * deepest**1.5, duration))
    return worst <= 1e-11, f"8 impacts, largest relative error {worst:.1e}"


def _total(found: Impact, structure: Modes, striker: Striker) -> float:
    """Return the energy at the end; an open contact has none."""
    return energy(structure, found.structure) + 0.5 * striker.mass_kg * found.body_speed_m_s**2


def impact_linear_energy() -> Observed:
    """impact of 1e5 to 1e8 N/m on the undamped fingertip; it rings and is hit again -> bounded: the energy of body,
    structure and contact is conserved within 1e-9"""
    return _kept(1.0)


def impact_hertz_energy() -> Observed:
    """the same with 1e5 to 1e8 N/m^1.5 -> bounded: energy is conserved within 1e-9"""
    return _kept(1.5)


def _kept(exponent: float) -> Observed:
    structure, worst, touches = modes(FABRICATED), 0.0, 0
    for k in _STIFFNESSES:
        striker = Striker(_MASS_KG, _SPEED, k, exponent)
        found = impact(structure, striker, 0.02)
        until = next((one.end_s for one in reversed(found.touches) if math.isfinite(one.end_s)), 0.02)
        touches += len(found.touches)
        # Just after the end of the last touch the contact has no energy.
        found = impact(structure, striker, until * (1.0 + 1e-9))
        worst = max(worst, abs(_total(found, structure, striker) / (0.5 * _MASS_KG * _SPEED**2) - 1.0))
    return worst <= 1e-9 and touches >= 4, f"{touches} touches, energy off by at most {worst:.1e}"


def impact_contact_force() -> Observed:
    """the same linear impacts, force sampled every 10 us -> pass: the contact only pushes: no sample is below zero, and
    none is above zero outside its contacts"""
    structure, t, least, stray, touches = modes(FABRICATED, 0.01), np.linspace(0.0, 0.02, 2001), 0.0, 0, 0
    for k in _STIFFNESSES:
        found = impact(structure, Striker(_MASS_KG, _SPEED, k), 0.02, t)
        force = found.contact_newtons[:, 0]
        inside = np.zeros(len(t), dtype=np.bool_)
        for one in found.touches:
            inside |= (t >= one.begin_s) & (t <= one.end_s)
        least, stray = min(least, float(force.min())), stray + int((force[~inside] != 0.0).sum())
        touches += len(found.touches)
    # At the very ends of a touch the force is 0 to rounding.
    return least >= -1e-9 and stray == 0, f"{touches} touches, least force {least:.1e} N, {stray} stray samples"


def impact_fixed_steps() -> Observed:
    """1e8 N/m in steps of 1 us to 100 us by Newmark, against the event-accurate run -> bounded: the error of the
    elastic force falls from step to step, and stays above that of events"""
    structure, striker = modes(FABRICATED, 0.01), Striker(_MASS_KG, _SPEED, 1e8)
    errors = []
    for step in (1e-4, 1e-5, 1e-6):
        t = np.arange(round(2e-3 / step) + 1) * step
        right = impact(structure, striker, float(t[-1]), t).elastic_newtons
        seen = integrators.newmark(integrators.Problem(structure, striker), integrators.no_load, t)
        errors.append(float(np.abs(seen - right).max() / np.abs(right).max()))
    held = errors[0] > errors[1] > errors[2] > 1e-12 and errors[2] < 0.02
    return held, f"relative errors at 100, 10 and 1 us: {', '.join(f'{error:.1e}' for error in errors)}"


def impact_stop() -> Observed:
    """the finger drives against a stop of infinite mass at 1 mm/s to 1 m/s -> pass: peak force scales with the speed
    within 1e-9: the system is linear while in contact"""
    structure, per_speed = modes(FABRICATED, 0.01), []
    for speed in (1e-3, 1e-2, 0.1, 1.0):
        per_speed.append(impact(structure, Striker(math.inf, speed, 1e7), 1e-3).touches[0].peak_newtons / speed)
    spread = max(per_speed) / min(per_speed) - 1.0
    return spread <= 1e-9, f"peak {per_speed[0]:.4g} N per m/s, spread {spread:.1e}"


def impact_mass_ratio() -> Observed:
    """bodies of 1e-9 to 1e3 kg on the fingertip, 1e8 N/m -> bounded: the first peak is within 0.1 % of v sqrt(k m), m
    the reduced mass of body and free tip: beams are soft compared with the contact"""
    structure, k, shares = modes(FABRICATED), 1e8, []
    for m in (1e-9, 1e-6, 1e-3, 1.0, 1e3):
        striker = Striker(m, _SPEED, k)
        along = structure.load_shape @ striker.direction
        together = 1.0 / (1.0 / m + float(along @ along))
        found = impact(structure, striker, 20.0 * math.sqrt(together / k))
        shares.append(found.touches[0].peak_newtons / (_SPEED * math.sqrt(k * together)))
    held = max(shares) <= 1.001 and min(shares) >= 0.999
    return held, f"first peaks are {min(shares):.6f} to {max(shares):.6f} of that"


def impact_impossible() -> Observed:
    """mass or stiffness 0, negative or NaN; speed 0; time inf; samples out of order -> refused: InputError names the
    value"""
    wrong = [(0.0, 0.1, 1e6), (-1.0, 0.1, 1e6), (math.nan, 0.1, 1e6), (1.0, 0.0, 1e6), (1.0, math.inf, 1e6),
             (1.0, 0.1, 0.0), (1.0, 0.1, math.nan), (1.0, 0.1, math.inf), (1.0, 0.1, 1e6, 1.2)]  # fmt: skip
    said = [refusal(Striker, *values) for values in wrong]
    good = Striker(1.0, 0.1, 1e6)
    said += [refusal(impact, None, good, time_s) for time_s in (math.inf, 0.0)]
    said += [refusal(impact, None, good, 1e-3, times) for times in ([5e-4, 4e-4], [2e-3], [math.nan])]
    return all("allowed" in text for text in said), f"{sum(map(bool, said))} of {len(said)} refused: {said[0]}"


def impact_softest() -> Observed:
    """beams of 1 nm struck with 1e8 N/m, 100000 s: time scales as 1 to 1e11 -> pass: one touch as on a free tip, and
    energy is kept within 1e-9"""
    structure, striker = modes(FABRICATED.thin(1e-9)), Striker(1e-3, 1e-3, 1e8)
    found = impact(structure, striker, 1e5)
    along = structure.load_shape @ striker.direction
    together = 1.0 / (1.0 / striker.mass_kg + float(along @ along))
    lasted = found.touches[0].end_s / (math.pi * math.sqrt(together / striker.stiffness))
    off = abs(_total(found, structure, striker) / (0.5 * striker.mass_kg * striker.speed_m_s**2) - 1.0)
    held = off <= 1e-9 and len(found.touches) == 1 and abs(lasted - 1.0) <= 1e-9
    return held, f"touch of {found.touches[0].end_s:.3g} s, energy off by {off:.1e}"


def impact_slit() -> Observed:
    """ramps to 1, 10 and 1000 times the load that closes the slit -> bounded: the stop opens no deeper than its force
    times its compliance; below the load it never touches"""
    structure = modes(FABRICATED, 0.02)
    stop = slit_stop(FABRICATED, structure)
    theta, phi = 0.5 * math.pi, 1.3 * math.pi
    load = closing_load(FABRICATED, theta, phi)
    direction = np.array([math.sin(phi), math.sin(phi - theta), math.cos(phi)])
    t, worst, touches = np.linspace(0.0, 0.1, 41), 0.0, []
    for factor in (0.9, 1.1, 10.0, 1000.0):
        found = overload(structure, stop, t, t[:, np.newaxis] / t[-1] * factor * load * direction)
        forces = found.contact_newtons
        free = found.elastic_newtons - forces @ stop.arms_per_newton.T  # of the open structure
        depth = free @ stop.closure_per_newton.T - stop.gap_m
        excess = depth - forces @ stop.compliance.T
        worst = max(worst, float(excess.max()) / stop.gap_m, float(-forces.min()))
        touches.append(len(found.touches))
    held = worst <= 1e-9 and touches[0] == 0 and all(touches[1:])
    return held, f"closes at {load:.3g} N; touches {touches}; deeper than the stop allows by {max(worst, 0.0):.1e}"
