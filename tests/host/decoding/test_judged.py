"""One data set with every fault, judged by a node sample by sample and by the host at once: the same verdicts."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fingertip.finger import PUSH, finger, record
from tipforce.fingertip.judgement import Judgement
from tipforce.fingertip.sample import Sample
from tipforce.host.configuration.calibration import Calibration, write_calibration
from tipforce.host.decoding import judged
from tipforce.host.decoding.contact_columns import ContactColumns
from tipforce.host.decoding.estimator import Before, Estimator, estimate
from tipforce.host.decoding.judged import Readings
from tipforce.host.decoding.log import read_log
from tipforce.host.decoding.sample_table import Table, computed, flag
from tipforce.samples import reasons
from tipforce.samples.reasons import Status
from tipforce.samples.record import JoinedSamples
from tipforce.scene import beam_calibration
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.scalar_redundancy import chi_square_threshold
from tools.decode.logs import decode, rows_of, write_log

NOISE = 5e-7
BITS = judged.GAUGES | 0xF000


@cache
def recorded(n: int) -> tuple[Calibration, list[Sample]]:
    """Samples of a node with ``n`` gauges: clean, drifting gauge by gauge, overloaded, warm, temperature unknown."""
    limit = chi_square_threshold(1e-6, n - 3) if n > 3 else 0.0
    data = record(
        n, noise_strain=NOISE, validity=(2.0, 4.0, 10.0, 30.0, 0.004), converter_limit=1e-3, offset_per_K=1e-7,
        gain_per_K=-3e-4, redundancy_limit=limit,
    )  # fmt: skip
    talk = finger(n, calibrated=data, load=PUSH, noise_microstrain=1e6 * NOISE)
    application: Any = talk.device.application
    found: list[Sample] = []

    def syncs(count: int) -> None:
        for _ in range(count):
            talk.now_us += 1000
            talk.step([(0x80, b"")])
            found.append(application.sample)

    syncs(100)
    for gauge in range(n):
        for microstrain in np.linspace(0.0, 12.0, 40):
            talk.source.offset_microstrain = [microstrain if k == gauge else 0.0 for k in range(n)]
            syncs(1)
    talk.source.offset_microstrain = [0.0] * n
    for newtons in (0.0, 1.9, 2.1, 3.9, 4.1, 3.9, 3.81, 3.7, 11.0, 1.0):
        talk.source.load = (newtons, *PUSH[1:])
        syncs(10)
    for temperature in (900, 999, 1001, 2999, 3001, -0x8000, 2300):
        talk.source.temperature = temperature
        syncs(10)
    return Calibration.from_record(data), found


def strains(samples: list[Sample]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Microstrain (k, n) and temperature in degC, NaN where unknown."""
    told = [s.reading.temperature if s.reading is not None else -0x8000 for s in samples]
    return np.array([s.microstrains for s in samples]), np.array([math.nan if t == -0x8000 else t / 100 for t in told])


@pytest.mark.parametrize("n", [3, 4, 5, 6, 8])
def test_the_verdicts_of_node_and_host_are_equal(n: int) -> None:
    calibration, samples = recorded(n)
    microstrain, temperature = strains(samples)
    given = Readings(microstrain * 1e-6, temperature)
    found, _, _ = Estimator(calibration).rows(given, Before())
    lost = np.array([sum(1 << k for k, over in enumerate(s.overloads) if over) for s in samples])
    verdicts = judged.Judge(calibration).judge(given._replace(lost=lost), False)
    node = np.array([s.faults & BITS for s in samples])
    known = judged.is_finite(verdicts.F_newtons)
    np.testing.assert_array_equal(verdicts.faults[known], node[known])
    np.testing.assert_array_equal(verdicts.faults[~known] & 0xF000, node[~known] & 0xF000)
    np.testing.assert_array_equal(known, [s.solver is not None for s in samples])
    F, covariance = np.array(verdicts.F_newtons), np.array(np.broadcast_arrays(*verdicts.covariance))
    for k in np.flatnonzero(known):
        np.testing.assert_allclose(F[:, k], samples[k].force(), atol=1e-12)
        np.testing.assert_allclose(covariance[:, k], samples[k].covariance(), rtol=1e-7, atol=1e-15)
    shown = ~(np.array([s.unknown() for s in samples]) & scalar.UNKNOWN_FORCE).astype(bool)
    np.testing.assert_array_equal(np.isfinite(found.values[:, 0]), shown)
    seen = np.array(samples)[shown]
    np.testing.assert_allclose(found.values[shown, 0], [s.contact()[0] for s in seen], rtol=1e-12)
    np.testing.assert_allclose(found.values[shown, 3], [s.uncertainty()[0] for s in seen], rtol=1e-7)
    bits = {bit for bit in range(16) for value in node.tolist() if value >> bit & 1}
    assert bits >= {13, 14, 15, *({12} if n > 3 else set()), *({0, 3, 6} if n == 8 else set())}


@pytest.mark.parametrize("n", [3, 5, 8])
def test_decode_says_the_same(n: int) -> None:
    """The columns of `decode --calibration`, from gauges and temperature alone, in full precision."""
    calibration, samples = recorded(n)
    microstrain, temperature = strains(samples)
    # Before a log tells a temperature it is unknown, later the last one holds: unknown again is not in a log.
    told = ~np.isnan(temperature)
    table = log_table(np.arange(len(samples)) * 1_000_000, microstrain, temperature=temperature)
    (found,) = ContactColumns({None: calibration}, None).tables([table])
    unresolved = np.array([s.faults >> 12 & 1 == 1 and s.solver is None for s in samples])
    for name, node in (
        ("beyond_calibrated", [s.faults >> 13 & 1 for s in samples]),
        ("temperature_outside", [s.faults >> 14 & 1 for s in samples]),
        ("overload", [s.faults >> 15 & 1 for s in samples]),
        ("contradiction", unresolved),
        ("gauge_left_out", [s.spared for s in samples]),
    ):
        np.testing.assert_array_equal(found.values[name][told], np.array(node, dtype=np.int8)[told], name)
    estimated = estimate(calibration, microstrain, temperature_degC=temperature)
    assert estimated.has(Status.FAULT).tolist() == unresolved.tolist()
    hidden = np.array([bool(s.unknown() & scalar.UNKNOWN_FORCE) for s in samples])
    np.testing.assert_array_equal(np.isnan(found.values["P_N"])[told], hidden[told])
    shown = np.flatnonzero(told & ~hidden)
    P = [samples[row].contact()[0] for row in shown]
    np.testing.assert_allclose(found.values["P_N"][shown], P, rtol=1e-12)


def test_rows_in_parts_are_rows_at_once() -> None:
    """The hysteresis of contact and of overload goes over the border of two parts."""
    calibration, samples = recorded(5)
    microstrain, temperature = strains(samples)
    estimator = Estimator(calibration)
    _, whole, _ = estimator.rows(Readings(microstrain * 1e-6, temperature), Before())
    before, parts = Before(), []
    for start in range(0, len(samples), 37):
        part = slice(start, start + 37)
        _, status, before = estimator.rows(Readings(microstrain[part] * 1e-6, temperature[part]), before)
        parts.append(status)
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_four_gauges_isolate_nothing_not_even_a_gauge_that_no_force_moves() -> None:
    C = np.hstack((1e4 * np.eye(3), np.zeros((3, 1))))
    calibration = Calibration(C, np.zeros(4), 1e-12 * np.eye(4), redundancy_limit=24.0)
    microstrain = np.array([[100.0, 0.0, 0.0, 0.0], [100.0, 0.0, 0.0, 50.0]])
    found = judged.Judge(calibration).judge(Readings(1e-6 * microstrain), False)
    assert found.faults.tolist() == [0, 1 << 12]
    assert judged.is_finite(found.F_newtons).tolist() == [True, False]
    talk = finger(4, calibrated=calibration.record(), load=PUSH)
    application: Any = talk.device.application
    active = application.calibration.active
    assert active is not None
    for row, force in zip(microstrain.tolist(), (True, False), strict=True):
        one = Judgement(active, row, 0, math.nan, False)
        assert (one.force is not None, one.left_out) == (force, 0)


def log_table(t_ns: np.ndarray[Any, Any], microstrain: np.ndarray[Any, Any], **others: Any) -> Table:
    """The table of a node's gauges, sent in the order of ``t_ns``, and of other columns."""
    k, n = microstrain.shape
    columns = [computed(f"SG{gauge + 1}", "microstrain", 1) for gauge in range(n)]
    values = {column.name: microstrain[:, gauge] for gauge, column in enumerate(columns)} | others
    columns += [computed(name, "") if name == "temperature" else flag(name) for name in others]
    return Table(
        t_ns, np.full(k, 5, np.uint16), np.arange(k, dtype=np.int64), np.ones(k, np.bool_), tuple(columns), values
    )


def pushed(k: int, seed: int = 3) -> tuple[Calibration, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """(calibration, times, microstrain) of a constant push of 2 N with the noise of its gauges."""
    calibration = beam_calibration("I", pull=True)
    strain = np.linalg.solve(calibration.C, force_vector(2.0, np.radians(30.0), np.radians(70.0)).ravel())
    noise = np.random.default_rng(seed).normal(0.0, 0.5, (k, 3))
    return calibration, np.arange(k, dtype=np.int64) * 1_000_000, np.round(1e6 * strain + noise, 1)


@pytest.mark.parametrize("size", [7, 40, 200])
def test_decode_sees_a_gauge_that_stands_still(size: int) -> None:
    """Of a node that does not know it, not calibrated: by decode as by a node, after 32 readings, in any blocks."""
    calibration, t_ns, microstrain = pushed(200)
    microstrain[50:150, 1] = microstrain[50, 1]
    blocks = [slice(start, start + size) for start in range(0, 200, size)]
    tables = [log_table(t_ns[part], microstrain[part]) for part in blocks]
    P = np.concatenate([found.values["P_N"] for found in ContactColumns({None: calibration}, None).tables(tables)])
    assert np.flatnonzero(np.isnan(P)).tolist() == list(range(82, 150))


def test_read_log_and_decode_give_the_same(tmp_path: Path) -> None:
    """With the age of the tare, and the temperature that TPDO4 sent last."""
    calibration, _, microstrain = pushed(200)
    calibration = replace(
        calibration, tare_drift_strain_per_s=1e-4, offset_temperature_strain_per_K=np.array([2e-6, 1e-6, 0.0]),
        temperature_min_degC=10.0, temperature_max_degC=30.0,
    )  # fmt: skip
    frames = [row.tobytes().hex() for row in np.rint(10 * microstrain).astype("<i2")]
    lines = [f"({k / 1000:.6f}) can0 185#{row}03{k:02X}" for k, row in enumerate(frames)]
    lines.insert(0, "(0.000000) can0 485#C409000000000000")  # 25 degC
    path = write_log(tmp_path / "run.log", lines)
    write_calibration(tmp_path / "cal.toml", calibration)
    assert decode(path, "--calibration", tmp_path / "cal.toml", "-o", tmp_path / "run.csv") == 0
    rows = [row for row in rows_of(tmp_path / "run.csv") if row["counter"]]
    log = read_log(path, calibration=calibration)[5]
    sent = log.counter >= 0
    for name, values in (("P_N", log.P_newtons), ("u_P_N", log.u_P_newtons)):
        np.testing.assert_allclose(values[sent], [float(row[name]) for row in rows], atol=1e-6)
    assert {row["temperature_outside"] for row in rows} == {"0"}
    assert log.u_P_newtons[-1] > 2.0 * log.u_P_newtons[sent][0]


def test_a_gauge_left_out_is_judged_with_the_temperature() -> None:
    """The node left one out; without the temperature it would look like a drift of gauge 1 alone, which it is not."""
    calibration, samples = recorded(8)
    calibration = replace(
        calibration, offset_temperature_strain_per_K=np.where(np.arange(8) == 0, 2e-6, 0.0), gain_temperature_per_K=0.0
    )
    k = 40
    microstrain = np.array([s.microstrains for s in samples[:k]])
    microstrain[:, 0] += 2.0 * 6.0  # what 6 K explain
    degC = np.full(k, calibration.reference_temperature_degC + 6.0)
    table = log_table(np.arange(k, dtype=np.int64), microstrain, temperature=degC, saturated=np.ones(k, np.int8))
    (found,) = ContactColumns({None: calibration}, None).tables([table])
    assert np.isnan(found.values["P_N"]).all()


def test_live_samples_from_gauges_say_what_the_estimate_doubts() -> None:
    calibration, t_ns, microstrain = pushed(30)
    calibration = replace(calibration, calibrated_force_newtons=1.0)
    columns = {f"SG{gauge + 1}": column for gauge, column in enumerate(microstrain.T)}
    columns |= {name: np.ones(30, np.bool_) for name in ("calibrated", "contact")}
    samples = JoinedSamples(t_ns, np.full(30, 5, np.uint8), np.arange(30), columns, calibrations={5: calibration})
    assert np.isfinite(samples.contact).all()
    assert (samples.status & np.uint16(Status.BEYOND_CALIBRATED) != 0).all()
    assert "beyond the calibrated force" in reasons.doubts(int(samples.status[0]))
