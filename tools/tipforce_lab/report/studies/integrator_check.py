"""Independent references of the integrators: mass and stiffness matrices with scipy, nothing of the project's dynamics.

Shared with the studied code are the masses and the compliances of the structure alone, which other tests prove. Modes,
damping, motion and contact are computed here again, by scipy.linalg and scipy.integrate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.integrate
import scipy.linalg

from tipforce.arrays import FloatArray
from tipforce.sensor.dynamics.model import STEEL_DENSITY, beam_mass_matrix, compliances, half_cylinder
from tipforce.sensor.structure.geometry import Geometry
from tipforce.sensor.structure.plane_frame import EULER_BERNOULLI, Frame
from tipforce_lab.dynamics.impact import Striker
from tipforce_lab.dynamics.integrators import Wave

METHOD = "scipy: mass and stiffness matrices, eigh, expm of the motion together with its load"
METHOD_OF_IMPACT = "scipy: mass and stiffness matrices, eigh, DOP853 (rtol 1e-13) from contact to contact"


@dataclass(frozen=True, slots=True)
class Body:
    """M y'' + D y' + K y = load F; elastic force = output y."""

    rate: FloatArray
    """(2 n, 2 n): of (y, y')."""
    push: FloatArray
    """(2 n, 3): acceleration per newton of F."""
    output: FloatArray
    """(3, 2 n)."""


def body(geometry: Geometry, damping_ratio: float, beams_with_mass: bool) -> Body:
    """Return the tip on its beams; with mass in the beams the joint's motion is a second set of unknowns."""
    arms, vertical = compliances(Frame(geometry, EULER_BERNOULLI))
    tip = half_cylinder(geometry).matrix(geometry.r_m)
    if beams_with_mass:
        M = np.kron(np.ones((2, 2)), tip) + beam_mass_matrix(geometry, STEEL_DENSITY, EULER_BERNOULLI)
        K = scipy.linalg.block_diag(scipy.linalg.inv(vertical), scipy.linalg.inv(arms))
        load, output = np.vstack([np.eye(3), np.eye(3)]), np.hstack([np.zeros((3, 3)), scipy.linalg.inv(arms)])
    else:
        M, K = tip, scipy.linalg.inv(arms + vertical)
        load, output = np.eye(3), K
    omega2, shapes = scipy.linalg.eigh(K, M)
    n, inverse = len(M), scipy.linalg.inv(M)
    D = M @ shapes @ np.diag(2.0 * damping_ratio * np.sqrt(omega2)) @ shapes.T @ M
    rate = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    push = np.vstack([np.zeros((n, 3)), inverse @ load])
    return Body(rate, push, np.hstack([output, np.zeros((3, n))]))


def driven(driven_body: Body, wave: Wave, times_s: FloatArray) -> FloatArray:
    """Return the elastic force (m, 3) from rest under a wave, at equal steps from 0; its end is one of the times."""
    n, w = len(driven_body.rate), 2.0 * math.pi * wave.frequency_hz
    shape = np.outer(wave.force, [wave.mean, wave.cosine, wave.sine])
    # The load is shape @ (1, c, s), the states of a generator that turns: c' = -w s, s' = w c.
    turning = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -w], [0.0, w, 0.0]])
    step_s, across = float(times_s[1] - times_s[0]), []
    for acting in (shape, 0.0 * shape):
        together = np.block([[driven_body.rate, driven_body.push @ acting], [np.zeros((3, n)), turning]])
        across.append(scipy.linalg.expm(together * step_s))
    X = np.append(np.zeros(n), [1.0, 1.0, 0.0])
    elastic = [driven_body.output @ X[:n]]
    for time_s in times_s[1:]:
        X = across[int(time_s > wave.until_s * (1.0 + 1e-9))] @ X
        elastic.append(driven_body.output @ X[:n])
    return np.array(elastic)


def struck(struck_body: Body, striker: Striker, times_s: FloatArray) -> FloatArray:
    """Return the elastic force after a body with a linear contact meets the tip; states: (y, y', overlap, speed)."""
    n = len(struck_body.rate)
    half = n // 2
    along = striker.direction
    pull = struck_body.push @ along  # of the structure, per newton of contact force

    def rate(_t: float, X: FloatArray) -> FloatArray:
        force = striker.stiffness * X[n] if closed else 0.0
        tip = along @ X[half:n]
        return np.concatenate([struck_body.rate @ X[:n] + pull * force, [X[n + 1] - tip, -force / striker.mass_kg]])

    def edge(_t: float, X: FloatArray) -> float:
        return float(X[n])

    edge.terminal = True  # type: ignore[attr-defined]
    X, t, closed = np.append(np.zeros(n), [0.0, striker.speed_m_s]), 0.0, True
    elastic = np.zeros((len(times_s), 3))
    scale = striker.speed_m_s * math.sqrt(striker.mass_kg / striker.stiffness)
    done = 1
    while done < len(times_s):
        edge.direction = -1.0 if closed else 1.0  # type: ignore[attr-defined]
        run = scipy.integrate.solve_ivp(
            rate, (t, float(times_s[-1])), X, "DOP853", dense_output=True, events=edge, rtol=1e-13, atol=1e-13 * scale
        )
        reached = times_s <= run.t[-1] * (1.0 + 1e-15)
        for k in range(done, int(reached.sum())):
            elastic[k] = struck_body.output @ run.sol(times_s[k])[:n]
        done = max(done, int(reached.sum()))
        t, X, closed = float(run.t[-1]), run.y[:, -1], not closed
        X[n] = 0.0
    return elastic
