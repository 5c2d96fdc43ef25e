"""Extreme structures and steps: stiffness ratios to 1e8, no damping and extreme damping, steps from 1 ns to 1 s.

Integrators for comparison beyond their range of validity: their failures must not look like results."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from stability.case import Observed, energy, refusal
from tipforce.arrays import FloatArray
from tipforce.errors import InputError
from tipforce.sensor.dynamics import first_order_hold as stepping
from tipforce.sensor.dynamics.model import Modes, RigidBody, compliances, half_cylinder, modes
from tipforce.sensor.structure.plane_frame import Frame
from tipforce.sensor.structure.strain import FABRICATED
from tipforce.sources.dynamic_load import DynamicLoad
from tipforce_lab.dynamics import integrators


def _polynomial(mass: FloatArray, compliance: FloatArray) -> list[Fraction]:
    """Return the exact coefficients of det(mass compliance - x), the constant first."""
    M, C = ([[Fraction(value) for value in row] for row in a.tolist()] for a in (mass, compliance))
    A = [[sum((M[i][k] * C[k][j] for k in range(3)), Fraction(0)) for j in range(3)] for i in range(3)]
    minors = sum((A[i][i] * A[j][j] - A[i][j] * A[j][i] for i in range(3) for j in range(i)), Fraction(0))
    det = sum((A[0][i] * (A[1][(i + 1) % 3] * A[2][(i + 2) % 3] - A[1][(i + 2) % 3] * A[2][(i + 1) % 3])
               for i in range(3)), Fraction(0))  # fmt: skip
    return [det, -minors, A[0][0] + A[1][1] + A[2][2], Fraction(-1)]


def _root_error(p: list[Fraction], x: float) -> float:
    """Return the relative Newton step from x, an estimate of the distance to the nearest root."""
    y = Fraction(x)
    value = p[0] + y * (p[1] + y * (p[2] + y * p[3]))
    slope = p[1] + y * (2 * p[2] + y * 3 * p[3])
    return abs(float(value / slope / y))


def dynamics_stiffness_ratio() -> Observed:
    """h2 / h1 from 1/316 to 1e6: omega^2 of the modes as 1 to 5e8 -> pass: every 1 / omega^2 is a root of the exact
    characteristic polynomial of mass and compliance within 1e-10"""
    worst, largest = 0.0, 0.0
    for power in np.arange(-2.5, 6.1, 0.5):
        geometry = replace(FABRICATED, h2_m=FABRICATED.h1_m * 10.0**power)
        found = modes(geometry)
        arms, vertical = compliances(Frame(geometry))
        p = _polynomial(half_cylinder(geometry).matrix(geometry.r_m), arms + vertical)
        worst = max(worst, *(_root_error(p, float(omega**-2)) for omega in found.omega_rad_s))
        largest = max(largest, float((found.omega_rad_s[-1] / found.omega_rad_s[0]) ** 2))
    return worst <= 1e-10 and largest > 1e8, f"ratios to {largest:.1e}, 1 / omega^2 off by at most {worst:.1e}"


def _static_error(found: Modes) -> float:
    """Return the relative difference of the elastic forces under a load at rest from the load."""
    identity = np.eye(3)
    return float(max(np.abs(shape @ found.load_shape - identity).max()
                     for shape in (found.force_shape, found.vertical_force_shape)))  # fmt: skip


def dynamics_light_joint() -> Observed:
    """a joint of 1e-6 to 1e-12 of the tip's mass: 6 modes, omega^2 ratios to 1e12 -> refused: up to 1e12 the static
    response is right within 1e-6; beyond, InputError names the limit"""
    tip = half_cylinder(FABRICATED)
    worst, largest, refused = 0.0, 0.0, 0
    for power in range(15):
        mass = tip.mass_kg * 10.0**-power
        joint = RigidBody(mass, 0.0, mass * 1e-6)
        try:
            found = modes(FABRICATED, joint=joint)
        except InputError as error:
            refused += "too much for floating point" in str(error)
            continue
        if refused:
            return False, f"a joint of 1e-{power} of the tip passes after a heavier one was refused"
        worst = max(worst, _static_error(found))
        largest = max(largest, float((found.omega_rad_s[-1] / found.omega_rad_s[0]) ** 2))
    held = worst <= 1e-6 and refused > 0 and 1e10 < largest <= 1e12
    return held, f"omega^2 ratios to {largest:.1e}: static force off by {worst:.1e}; {refused} lighter refused"


def dynamics_thickness() -> Observed:
    """h1 from 1e-6 mm to 10 mm: lowest frequencies from 4e-7 Hz to 9 kHz -> pass: the elastic force at rest equals the
    load within 1e-12"""
    worst, frequencies = 0.0, []
    for h1 in 10.0 ** np.arange(-9.0, -1.9, 0.5):
        found = modes(FABRICATED.thin(float(h1)))
        worst = max(worst, _static_error(found))
        frequencies.append(float(found.frequency_hz[0]))
    held = worst <= 1e-12 and all(a < b for a, b in itertools.pairwise(frequencies))
    return held, f"{frequencies[0]:.1e} to {frequencies[-1]:.1e} Hz, static force off by {worst:.1e}"


def dynamics_no_damping() -> Observed:
    """damping ratio 0, 100000 free steps of random length near one period -> bounded: energy stays within 1e-10"""
    found, rng = modes(FABRICATED), np.random.default_rng(15)
    state = stepping.State(found.load_shape @ [1.0, -0.5, 0.7], np.zeros(3))
    before, worst = energy(found, state), 0.0
    for _ in range(10):
        step = float(rng.uniform(1e-3, 2e-2))
        state = stepping.respond(found, np.zeros((10001, 3)), step, state).end
        worst = max(worst, abs(energy(found, state) / before - 1.0))
    return worst <= 1e-10, f"energy off by at most {worst:.1e} after 100000 steps"


def _step_response(x: float, zeta: float) -> float:
    """Return 1 - exp decay of one mode from rest under a constant load, from exact rates; zeta >= 1."""
    gamma = math.sqrt(float((Fraction(zeta) - 1) * (Fraction(zeta) + 1)))
    slow, fast = 1.0 / (zeta + gamma), zeta + gamma
    if gamma * x < 1e-3:  # both rates nearly equal: sinh(y) / y by its series
        y = gamma * x
        return 1.0 - math.exp(-zeta * x) * (math.cosh(y) + zeta * x * (1.0 + y * y / 6.0))
    if zeta < 1e2:
        return 1.0 - (fast * math.exp(-slow * x) - slow * math.exp(-fast * x)) / (2.0 * gamma)
    return (fast * -math.expm1(-slow * x) - slow * -math.expm1(-fast * x)) / (2.0 * gamma)


def dynamics_overdamped() -> Observed:
    """damping ratios 1, 1 +- 1e-9, 2, 1e3 and 1e6, one step of 1 ns to 1e6 s -> pass: the step response equals the
    closed form in exact decay rates, within 1e-12"""
    worst = 0.0
    base = modes(FABRICATED)
    F = np.array([0.2, 0.3, -0.9])
    for zeta in (1.0, 1.0 + 1e-9, 2.0, 1e3, 1e6):
        found = base.with_damping(zeta)
        for step in 10.0 ** np.arange(-9.0, 6.1, 1.0):
            z = stepping.respond(found, np.stack((F, F)), float(step)).end.position
            g = found.load_shape @ F
            exact = np.array([_step_response(float(omega * step), zeta) for omega in found.omega_rad_s])
            worst = max(worst, float(np.abs(z / g - exact).max()))
    below = base.with_damping(1.0 - 1e-9)
    two = [stepping.respond(m, np.stack((F, F)), 1e-3).elastic_newtons[-1] for m in (below, base.with_damping(1.0))]
    gap = float(np.abs(two[0] - two[1]).max())
    return worst <= 1e-12 and gap <= 1e-8, f"off by at most {worst:.1e} of the static response"


def dynamics_damping_impossible() -> Observed:
    """damping ratios -1e-9, 2e6, NaN, infinity -> refused: InputError says what is allowed"""
    said = [refusal(modes, FABRICATED, zeta) for zeta in (-1e-9, 2e6, math.nan, math.inf)]
    return all("allowed is 0 to 1e+06" in text for text in said), said[1]


def _ramp(modes_: Modes, steps: int, total_s: float) -> stepping.State:
    """Return the state after a ramp of total_s in equal steps, from rest."""
    F = np.linspace(0.0, 1.0, steps + 1)[:, np.newaxis] * np.array([0.3, -0.4, 0.8])
    return stepping.respond(modes_, F, total_s / steps).end


def _difference(one: stepping.State, other: stepping.State) -> float:
    """Return the difference relative to the largest element of the state."""
    a, b = (np.concatenate(state) for state in (one, other))
    return float(np.abs(a - b).max() / np.abs(b).max())


def _ramps_differ(steps: int, others: int, total_s: float, bound: float) -> Observed:
    worst = 0.0
    for zeta in (0.0, 0.02, 1.0, 1e3):
        found = modes(FABRICATED, zeta)
        worst = max(worst, _difference(_ramp(found, steps, total_s), _ramp(found, others, total_s)))
    return worst <= bound, f"largest difference {worst:.1e}"


def dynamics_step_1ns() -> Observed:
    """10000 steps of 1 ns against one of 10 us under the same ramp -> pass: position and velocity agree within 1e-12 of
    the largest"""
    return _ramps_differ(10_000, 1, 1e-5, 1e-12)


def dynamics_step_1s() -> Observed:
    """one step of 1 s (470 periods of the fastest mode) against 100000 of 10 us -> pass: the same ramp gives the same
    end within 1e-9 of the largest; no stability limit"""
    return _ramps_differ(1, 100_000, 1.0, 1e-9)


def dynamics_steps_mixed() -> Observed:
    """steps drawn from 1 ns to 1 s in one run, load linear in between -> pass: the end equals that of exact steps of
    half the length within 1e-9"""
    rng = np.random.default_rng(16)
    found = modes(FABRICATED, [0.0, 0.01, 2.0])
    steps, F = 10.0 ** rng.uniform(-9.0, 0.0, 60), rng.standard_normal((61, 3))
    whole = halved = stepping.at_rest(found)
    for step, before, after in zip(steps.tolist(), F[:-1], F[1:], strict=True):
        whole = stepping.respond(found, np.stack((before, after)), step, whole).end
        halved = stepping.respond(found, np.stack((before, 0.5 * (before + after), after)), 0.5 * step, halved).end
    off = _difference(whole, halved)
    return off <= 1e-9, f"60 steps of {steps.min():.0e} to {steps.max():.1g} s: {off:.1e}"


def dynamics_step_impossible() -> Observed:
    """steps of -1 ns, NaN and infinity -> refused: InputError says what is allowed; a step of 0 changes nothing"""
    found, F = modes(FABRICATED), np.ones((2, 3))
    said = [refusal(stepping.respond, found, F, step) for step in (-1e-9, math.nan, math.inf)]
    start = stepping.State(np.array([1.0, 2.0, 3.0]), np.zeros(3))
    same = _difference(stepping.respond(found, F, 0.0, start).end, start)
    return all("allowed" in text for text in said) and same == 0.0, f"{said[0]}; step 0 changes {same:g}"


def dynamics_load_not_finite() -> Observed:
    """NaN and infinity in one sample of a load of 1000 -> flagged: the elastic force is right before it and not finite
    from it on"""
    found, held = modes(FABRICATED, 0.01), True
    F = np.random.default_rng(17).standard_normal((1000, 3))
    good = stepping.respond(found, F, 1e-4).elastic_newtons
    for bad in (math.nan, math.inf):
        spoilt = F.copy()
        spoilt[500, 1] = bad
        with np.errstate(invalid="ignore"):
            seen = stepping.respond(found, spoilt, 1e-4).elastic_newtons
        held &= bool(np.allclose(seen[:500], good[:500], rtol=0.0, atol=1e-12))
        held &= not np.isfinite(seen[500:]).all(axis=1).any()
    return held, "500 samples as before, 500 not finite"


def dynamics_load_sizes() -> Observed:
    """loads of 1e-300 to 1e290 N and a denormal -> pass: the response scales with them within 1e-12; a denormal load
    gives no NaN"""
    found = modes(FABRICATED, 0.01)
    F = np.random.default_rng(18).standard_normal((200, 3))
    one, worst = stepping.respond(found, F, 1e-4).elastic_newtons, 0.0
    for power in (-990, -500, 500, 960):
        scaled = stepping.respond(found, np.ldexp(F, power), 1e-4).elastic_newtons
        worst = max(worst, float(np.abs(np.ldexp(scaled, -power) - one).max() / np.abs(one).max()))
    tiny = stepping.respond(found, np.full((200, 3), 5e-324), 1e-4).elastic_newtons
    held = worst <= 1e-12 and bool(np.isfinite(tiny).all()) and float(np.abs(tiny).max()) < 1e-320
    return held, f"relative difference {worst:.1e}; denormal load: at most {np.abs(tiny).max():.0e} N"


def dynamics_node() -> Observed:
    """the node's own stepping at 500 us and 1 s, damping 0 and 1e6 -> pass: it equals the host's within 1e-12 of the
    load"""
    worst = 0.0
    F = np.random.default_rng(19).standard_normal((500, 3))
    for zeta in (0.0, 0.02, 1e6):
        found = modes(FABRICATED, zeta)
        for step in (5e-4, 1.0):
            node = DynamicLoad(stepping.node_coefficients(found, step))
            node.settle((0.0, 0.0, 0.0))
            ours = np.array([node.step(a, b) for a, b in zip(F[:-1].tolist(), F[1:].tolist(), strict=True)])
            worst = max(worst, float(np.abs(ours - stepping.respond(found, F, step).elastic_newtons[1:]).max()))
    return worst <= 1e-11, f"largest difference {worst:.1e} N on loads of 1 N"


def integrator_rk4_unstable() -> Observed:
    """RK4 with steps 1 % below and 1 % above its limit, undamped, 8000 steps -> flagged: below the limit it decays,
    above it grows past 1e10 or becomes infinite: it cannot be taken for a result"""
    found = modes(FABRICATED)
    problem = integrators.Problem(found)
    limit = integrators.rk4_stability_limit(0.0) / float(found.omega_rad_s[-1])
    sizes = []
    for factor in (0.99, 1.01, 100.0):
        t = np.arange(8001 if factor < 2 else 200) * limit * factor
        with np.errstate(over="ignore", invalid="ignore"):
            end = integrators.runge_kutta_4(problem, lambda time_s: np.array([1.0, 0.0, 1.0]) * (time_s < limit), t)[-1]
        sizes.append(float(np.abs(end).max()))
    held = sizes[0] < 10.0 and all(not size < 1e10 for size in sizes[1:])
    return held, f"end at 0.99, 1.01 and 100 times the limit: {', '.join(f'{size:.2g}' for size in sizes)} N"


def integrator_implicit_long_steps() -> Observed:
    """Newmark and generalised-alpha with steps of 1000 periods -> bounded: the response to a step load stays below
    twice the static one: stable, though not exact"""
    found, largest = modes(FABRICATED), []
    t = np.arange(2001) * 1000.0 / float(found.frequency_hz[0])
    for method in (integrators.newmark, integrators.generalised_alpha):
        elastic = method(integrators.Problem(found), lambda _time_s: np.array([1.0, 0.0, 1.0]), t)
        largest.append(float(np.abs(elastic).max()))
    return max(largest) <= 2.0 + 1e-6, f"largest elastic force {largest[0]:.3f} and {largest[1]:.3f} N for 1 N"


def integrator_times_impossible() -> Observed:
    """times that are equal, fall, or are NaN, or a single one -> refused: InputError of every method says that times
    must rise strictly"""
    problem = integrators.Problem(modes(FABRICATED))
    wrong = ([0.0, 1e-4, 1e-4], [0.0, 2e-4, 1e-4], [0.0, float("nan"), 1.0], [0.0])
    methods = (integrators.runge_kutta_4, integrators.newmark, integrators.generalised_alpha)
    said = [refusal(method, problem, integrators.no_load, t) for t in wrong for method in methods]
    refused = sum("rise strictly" in text for text in said)
    return refused == len(said), f"{refused} of {len(said)} refused"
