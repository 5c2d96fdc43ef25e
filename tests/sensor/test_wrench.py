"""Six axes: the contact centroid on every surface, against the contact that made the wrench, derivatives, the plane."""

from __future__ import annotations

import subprocess
import sys
from math import inf, nan, pi, sqrt

import numpy as np
import numpy.typing as npt
import pytest

from tipforce.errors import InputError
from tipforce.sensor.contact import estimate as planar
from tipforce.sensor.contact.force import force_vector
from tipforce.sensor.contact.scalar import CONTACT_PRESENT, MISSES_TIP, OUTSIDE_PAD, THETA_UNRESOLVED
from tipforce.sensor.surfaces import Cylinder, Ellipsoid, HalfPlane, Surface, sphere
from tipforce.sensor.wrench import Limits, contacts, standard_uncertainties, status

FloatArray = npt.NDArray[np.float64]
R = 0.015
PLANE = HalfPlane((0.6, 0.8, 0.0), 0.01, (0.8, -0.6, 0.0), 0.02)
SURFACES: dict[str, Surface] = {
    "sphere": sphere(R),
    "ellipsoid": Ellipsoid((0.01, 0.02, 0.015)),
    "cylinder": Cylinder(R),
    "half-plane": PLANE,
}
LIMITS = Limits(0.05, 0.03, 1e-3)


def points(rng: np.random.Generator, name: str, count: int) -> FloatArray:
    """Points on a surface, (count, 3)."""
    v = rng.normal(size=(count, 3))
    u: FloatArray = v / np.linalg.norm(v, axis=1, keepdims=True)
    if name in ("sphere", "ellipsoid"):
        stretched: FloatArray = u * (np.array([R, R, R]) if name == "sphere" else np.array([0.01, 0.02, 0.015]))
        return stretched
    if name == "cylinder":
        theta = rng.uniform(-pi, pi, count)
        return np.stack([R * np.cos(theta), R * np.sin(theta), rng.uniform(-0.02, 0.02, count)], axis=-1)
    n, e = np.array(PLANE.normal), np.array(PLANE.edge)
    s, t = rng.uniform(-0.02, 0.02, (2, count, 1))
    flat: FloatArray = 0.01 * n + s * e + t * np.cross(n, e)
    return flat


def pushes(rng: np.random.Generator, name: str, count: int, friction: float = 1.0) -> tuple[FloatArray, ...]:
    """(wrench, centroid, normal, torque) of soft-finger pushes inside a friction cone."""
    surface, c = SURFACES[name], points(rng, name, count)
    gradient = surface.gradient(c)
    n = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    sideways = np.cross(n, rng.normal(size=(count, 3)))
    sideways *= friction * rng.uniform(0, 1, (count, 1)) / np.linalg.norm(sideways, axis=1, keepdims=True)
    f = rng.uniform(0.1, 5.0, (count, 1)) * (sideways - n)
    torque = 0.2 * R * rng.uniform(-1, 1, count) * np.linalg.norm(f, axis=1)
    m = np.cross(c, f) + torque[:, np.newaxis] * n
    return np.concatenate([f, m], axis=1), c, n, torque


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("unit", [1e-290, 1.0, 1e290])
def test_the_contact_that_made_the_wrench_comes_back(name: str, unit: float) -> None:
    wrench, c, n, torque = pushes(np.random.default_rng(1), name, 500)
    found = contacts(wrench * unit, SURFACES[name])
    np.testing.assert_allclose(found.centroid_m, c, atol=1e-12)
    np.testing.assert_allclose(found.normal, n, atol=1e-10)
    np.testing.assert_allclose(found.torque_newton_metres / unit, torque, atol=1e-12)
    np.testing.assert_allclose(found.force_newtons / unit, np.linalg.norm(wrench[:, :3], axis=1), rtol=1e-12)
    assert (found.normal_newtons > 0.0).all()
    assert not found.miss_newtons.any()


@pytest.mark.parametrize("name", ["sphere", "ellipsoid"])
def test_no_torque_about_the_normal_divides_by_nothing(name: str) -> None:
    rng = np.random.default_rng(2)
    wrench, c, _, _ = pushes(rng, name, 300)
    wrench[:, 3:] = np.cross(c, wrench[:, :3])  # f . m is zero but for rounding
    found = contacts(wrench, SURFACES[name])
    np.testing.assert_allclose(found.centroid_m, c, atol=1e-8)
    # Exactly zero: a load in the plane.
    flat = np.zeros((300, 6))
    theta = rng.uniform(-pi, pi, 300)
    delta = rng.uniform(-1.2, 1.2, 300)
    flat[:, 0], flat[:, 1] = np.cos(theta + delta + pi), np.sin(theta + delta + pi)
    axes = np.array([R, R]) if name == "sphere" else np.array([0.01, 0.02])
    edge = np.stack([np.cos(theta), np.sin(theta)], axis=-1) * axes
    flat[:, 5] = edge[:, 0] * flat[:, 1] - edge[:, 1] * flat[:, 0]
    found = contacts(flat, SURFACES[name])
    back = np.cross(found.centroid_m, flat[:, :3])
    np.testing.assert_allclose(back, flat[:, 3:], atol=1e-15)
    assert not found.torque_newton_metres.any()
    assert not found.centroid_m[:, 2].any()


def planar_wrench(F: FloatArray) -> FloatArray:
    zero = np.zeros(F.shape[:-1])
    return np.stack([F[..., 2], F[..., 0], zero, zero, zero, R * F[..., 1]], axis=-1)


@pytest.mark.parametrize("surface", [Cylinder(R), sphere(R)], ids=["cylinder", "sphere"])
def test_a_planar_load_gives_what_the_planar_estimator_gives(surface: Surface) -> None:
    rng = np.random.default_rng(3)
    theta, delta = rng.uniform(-pi, pi, 2000), np.radians(rng.uniform(-89.9, 89.9, 2000))
    F = force_vector(rng.uniform(0.01, 10.0, 2000), theta + delta + pi, theta)
    expected, found = planar.contacts(F, pull=False), contacts(planar_wrench(F), surface)
    rounding = 4e-16 / np.abs(np.cos(delta)) + 2e-15
    np.testing.assert_allclose(found.force_newtons, expected.P_newtons, rtol=1e-15)
    error = np.remainder(np.arctan2(found.centroid_m[:, 1], found.centroid_m[:, 0]) - expected.theta_rad + pi, 2 * pi)
    assert (np.abs(error - pi) < 4 * rounding).all()
    assert np.abs(found.centroid_m[:, 2]).max() == 0.0
    np.testing.assert_allclose(found.normal_newtons, -F_along_normal(expected), rtol=1e-9, atol=1e-12)
    # Torque: from the cylinder, nothing but the rounding of x and y; from the sphere exactly nothing.
    assert np.abs(found.torque_newton_metres).max() < 1e-16


def F_along_normal(found: planar.Contact) -> FloatArray:
    result: FloatArray = found.P_newtons * np.cos(found.delta_rad)
    return result


@pytest.mark.parametrize("surface", [Cylinder(R), sphere(R)], ids=["cylinder", "sphere"])
def test_uncertainty_of_a_planar_load_is_the_planar_one(surface: Surface) -> None:
    rng = np.random.default_rng(4)
    theta, delta = rng.uniform(-pi, pi, 50), rng.uniform(-1.0, 1.0, 50)
    F = force_vector(2.0, theta + delta + pi, theta)
    root = 1e-6 * rng.normal(size=(3, 3))
    K = np.zeros((6, 6))
    order = [1, 5, 0]  # F1 = fy, F2 = mz / R, F3 = fx
    K[np.ix_(order, order)] = np.diag([1, R, 1]) @ root @ root.T @ np.diag([1, R, 1])
    expected = planar.standard_uncertainties(F, root @ root.T, pull=False)
    found = standard_uncertainties(planar_wrench(F), K, surface)
    np.testing.assert_allclose(found.force_newtons, expected[:, 0], rtol=1e-6)
    np.testing.assert_allclose(found.centroid_m, R * expected[:, 2], rtol=1e-4)
    np.testing.assert_allclose(found.miss_newtons, planar.miss_uncertainties(F, root @ root.T), rtol=1e-6)


@pytest.mark.parametrize("name", SURFACES)
def test_uncertainties_are_the_derivatives(name: str) -> None:
    rng = np.random.default_rng(5)
    surface = SURFACES[name]
    wrench, _, _, _ = pushes(rng, name, 30)
    scale = np.array([1.0, 1.0, 1.0, R, R, R])
    for w in wrench:
        h = 1e-6 * scale
        above, below = contacts(w + np.diag(h), surface), contacts(w - np.diag(h), surface)
        centroid = (above.centroid_m - below.centroid_m).T / (2 * h)
        torque = (above.torque_newton_metres - below.torque_newton_metres) / (2 * h)
        force = (above.force_newtons - below.force_newtons) / (2 * h)
        root = 1e-3 * scale[:, np.newaxis] * rng.normal(size=(6, 6))
        K = root @ root.T
        found = standard_uncertainties(w, K, surface)
        expected = centroid @ K @ centroid.T
        tolerance = 1e-6 * np.abs(expected).max()
        np.testing.assert_allclose(found.centroid_covariance_m2, expected, rtol=1e-5, atol=tolerance)
        assert found.torque_newton_metres == pytest.approx(sqrt(torque @ K @ torque), rel=1e-5)
        assert found.force_newtons == pytest.approx(sqrt(force @ K @ force), rel=1e-6)
        _, gradient = surface.excess(w[:3], w[3:])
        ahead, _ = surface.excess((w + np.diag(h))[:, :3], (w + np.diag(h))[:, 3:])
        behind, _ = surface.excess((w - np.diag(h))[:, :3], (w - np.diag(h))[:, 3:])
        np.testing.assert_allclose((ahead - behind) / (2 * h), gradient, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", SURFACES)
def test_monte_carlo(name: str) -> None:
    rng = np.random.default_rng(6)
    surface = SURFACES[name]
    wrench, c, _, _ = pushes(rng, name, 1, friction=0.5)
    scale = 1e-3 * np.linalg.norm(wrench[0, :3]) * np.array([1.0, 1.0, 1.0, R, R, R])
    noisy = wrench[0] + scale * rng.normal(size=(40_000, 6))
    error = contacts(noisy, surface).centroid_m - c[0]
    found = standard_uncertainties(wrench[0], np.diag(scale**2), surface)
    spread = error.T @ error / len(error)
    np.testing.assert_allclose(found.centroid_covariance_m2, spread, atol=0.03 * np.abs(spread).max())


def test_a_load_that_misses_is_measured_and_flagged() -> None:
    F = np.array([[0.6, 1.5, 0.8], [0.6, -1.5, 0.8], [0.6, 1.004, 0.8], [0.6, 0.5, 0.8]])
    K = np.diag([1e-4, 1e-4, 1e-4, 1e-4 * R**2, 1e-4 * R**2, 1e-4 * R**2])
    for surface in (Cylinder(R), sphere(R)):
        found = contacts(planar_wrench(F), surface)
        np.testing.assert_allclose(found.miss_newtons, planar.contacts(F, pull=False).miss_newtons, atol=1e-15)
        bits = status(found, standard_uncertainties(planar_wrench(F), K, surface), surface, LIMITS)
        assert (bits & MISSES_TIP != 0).tolist() == [True, True, False, False]  # the third is within 3 u
    # A plane is missed by a force that pulls.
    pulled = contacts([[0.6, 0.8, 0.0, 0.0, 0.0, 0.0]], PLANE)
    assert pulled.miss_newtons[0] == pytest.approx(1.0)
    assert np.isnan(pulled.centroid_m).all()


def test_tangential_is_infinite_and_unresolved() -> None:
    F = force_vector(1.0, 0.3, 0.3 - pi / 2)
    for surface in (Cylinder(R), sphere(R)):
        wrench = planar_wrench(np.round(F[np.newaxis], 15))
        exact = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, R]])
        for w in (wrench, exact):
            u = standard_uncertainties(w, 1e-6 * np.eye(6), surface)
            assert u.centroid_m[0] > 1e-3
            assert status(contacts(w, surface), u, surface, LIMITS)[0] & THETA_UNRESOLVED


def test_status_and_edges() -> None:
    pad = Cylinder(R, half_length_m=5e-3, theta_min_rad=0.0, theta_max_rad=pi)
    theta = np.radians([90.0, 90.0, -90.0])
    c = np.stack([R * np.cos(theta), R * np.sin(theta), [0.0, 6e-3, 0.0]], axis=-1)
    f = -c * np.array([1.0, 1.0, 0.0]) / R
    w = np.concatenate([f, np.cross(c, f)], axis=1)
    K = 1e-8 * np.eye(6) * np.array([1, 1, 1, R**2, R**2, R**2])
    bits = status(contacts(w, pad), standard_uncertainties(w, K, pad), pad, LIMITS)
    assert bits.tolist() == [CONTACT_PRESENT, CONTACT_PRESENT | OUTSIDE_PAD, CONTACT_PRESENT | OUTSIDE_PAD]
    small = w * np.array([[0.04], [0.06], [0.04]])
    bits = status(contacts(small, pad), standard_uncertainties(small, K, pad), pad, LIMITS)
    assert (bits & CONTACT_PRESENT).tolist() == [0, CONTACT_PRESENT, CONTACT_PRESENT]
    assert status(contacts(small, pad), standard_uncertainties(small, K, pad), pad, LIMITS, True)[0] & CONTACT_PRESENT
    over = np.array([[-0.6, -0.8, 0.0, *np.cross([0.03, -0.01, 0.0], [-0.6, -0.8, 0.0])]])
    found = contacts(over, PLANE)
    assert found.centroid_m[0] @ np.array(PLANE.normal) == pytest.approx(0.01)
    assert PLANE.outside(found.centroid_m).tolist() == [True]
    assert not HalfPlane((0.0, 1.0, 0.0), 0.0).outside(found.centroid_m).any()


@pytest.mark.parametrize("name", SURFACES)
def test_what_is_not_finite_or_no_load_is_nan_alone_in_its_row(name: str) -> None:
    surface = SURFACES[name]
    wrench, c, _, _ = pushes(np.random.default_rng(7), name, 4)
    wrench[1, 2], wrench[2, 5], wrench[3] = nan, inf, 0.0
    found = contacts(wrench, surface)
    np.testing.assert_allclose(found.centroid_m[0], c[0], atol=1e-12)
    assert np.isnan(found.centroid_m[1:]).all()
    assert np.isnan(found.force_newtons[1:3]).all()
    assert found.force_newtons[3] == 0.0
    u = standard_uncertainties(wrench, 1e-8 * np.eye(6), surface)
    assert np.isfinite(u.centroid_m[0])
    assert np.isnan(u.centroid_m[1:]).all()
    bits = status(found, u, surface, LIMITS)
    assert (bits & THETA_UNRESOLVED != 0).tolist() == [False, True, True, True]
    assert (bits & CONTACT_PRESENT != 0).tolist() == [True, False, False, False]


def test_errors() -> None:
    ball = sphere(R)
    good = contacts(np.ones((2, 6)), ball)
    u = standard_uncertainties(np.ones((2, 6)), np.eye(6), ball)
    for call, text in (
        (lambda: contacts(np.ones(5), ball), "wrench has the shape"),
        (lambda: standard_uncertainties(np.ones(6), np.eye(5), ball), "covariance has the shape"),
        (lambda: status(good, u, ball, Limits(0.1, 0.2, 1.0)), "contact_off_newtons = 0.2"),
        (lambda: status(contacts(np.ones(6), ball), u, ball, LIMITS), r"allowed are \(n,\)"),
        (lambda: sphere(0.0), "semi_axes_m = 0.0"),
        (lambda: Ellipsoid((1.0, nan, 1.0)), "semi_axes_m = nan"),
        (lambda: Cylinder(-1.0), "radius_m"),
        (lambda: Cylinder(R, half_length_m=0.0), "half_length_m"),
        (lambda: Cylinder(R, theta_min_rad=2.0, theta_max_rad=1.0), "theta_min_rad"),
        (lambda: HalfPlane((1.0, 1.0, 0.0), 0.0), "normal"),
        (lambda: HalfPlane((1.0, 0.0, 0.0), 0.0, (1.0, 0.0, 0.0)), "across the normal"),
        (lambda: HalfPlane((1.0, 0.0, 0.0), nan), "distance_m"),
    ):
        with pytest.raises(InputError, match=text):
            call()
    assert status(good, u, ball, LIMITS).dtype == np.uint8


def test_a_planar_node_and_host_never_import_it() -> None:
    code = (
        "import sys, tipforce.fingertip.node, tipforce.host.network.finger, tipforce.host.decoding.decoder, tipforce.sensor.contact.estimate, "
        "tipforce_tools.cli.main, tipforce_tools.node.command, tipforce_tools.demo.command; "
        "print(*[m for m in sys.modules if m.endswith(('sensor.wrench', 'sensor.surfaces'))])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert shown.stdout.strip() == ""
