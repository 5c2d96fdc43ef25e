"""Which way of showing a value says ok and is wrong, by more than five of its own standard uncertainties of P, for
every fault of a scene, by number of gauges. `tipforce calibrate fit` calibrates each finger; the node's code runs."""

import csv
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

import tipforce
from canopen_device.core import codes
from tipforce.arrays import BoolArray, FloatArray
from tipforce.fingertip.node import Fingertip
from tipforce.host.configuration.calibration import Calibration, read_calibration
from tipforce.host.decoding.contact_columns import FLAGS, ContactColumns
from tipforce.host.decoding.sample_table import Table, computed, flag
from tipforce.samples.reasons import Status
from tipforce.scene import schema
from tipforce.scene.build import build
from tipforce.scene.results import applied_at
from tipforce.scene.run import simulate
from tipforce.sensor import FABRICATED, force_vector, parity, strain_matrix
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.contact import scalar
from tipforce.sensor.contact.scalar_redundancy import LEAST_SHARE
from tipforce_lab.report.study import Counted, Effort, Grid, GridRow, sums_of

GAUGES = ("K_H", "S_H", "U", "L", "T", "R", "K_V", "S_V")
COUNTS = (3, 4, 5, 8)
QUICK_COUNTS = (3, 5)
STEPS = len(COUNTS)
NOISE_MICROSTRAIN = 1.0
NODE_ID, SYNC_HZ = 5, 50.0
LARGEST_NEWTONS = 4.4
FAULT_FROM = 0.3
"""Share of the scene before its fault."""
TOO_FAR = 5.0
"""Own standard uncertainties."""
ALLOWED_WRONG_SHARE = 1e-4
COLD_DEGC, WARM_DEGC = 23.0, ((0.0, 23.0), (1.0, 43.0))

NODE, NODE_FAULTS, DECODE, ESTIMATE, BARE = (
    "node, contact PDO alone", "node, contact PDO and 2124h", "tipforce decode --calibration", "tipforce estimate",
    "tipforce estimate, no temperature",
)  # fmt: skip
METHODS = (NODE, NODE_FAULTS, DECODE, ESTIMATE, BARE)
KINDS: tuple[schema.FaultKind, ...] = get_args(schema.FaultKind)
FAULTS = ("none", *KINDS, "warm", "overload", "1/f noise", "vibration")
"""The kinds of [[faults]], and what other tables of a scene do to the reading."""

_SPARE = "three gauges fit every reading: none is spare to contradict them"
_ONE_SPARE = "one spare gauge: a fault that is small beside the force cannot be told from noise"
_HIDDEN = "a gauge that shows less than 10 % of its variance in the residuals: its fault passes as a force"
_ELASTIC = "gauges measure the elastic force, not the load: docs/dynamics.md"
_WANDERS = "the zero wanders after the tare: tare again, or state a drift rate"
CANNOT_TELL: dict[tuple[str, int], str] = {
    ("drift", 3): _SPARE,
    ("drift", 4): _ONE_SPARE,
    ("stuck", 3): _SPARE + "; a frozen one shows after 32 equal readings",
    ("stuck", 4): _ONE_SPARE,
    **{("vibration", n): _ELASTIC for n in COUNTS},
    **{("1/f noise", n): _WANDERS for n in COUNTS},
}
"""(fault, gauges) -> why the data cannot always tell."""
_NOT_IN_PDO = "bits 13 to 15 are in 2124h, not in the contact PDO"
NOT_TOLD: dict[tuple[str, str], str] = {
    ("warm", NODE): _NOT_IN_PDO,
    ("overload", NODE): _NOT_IN_PDO,
    ("warm", BARE): "no temperature is given, so none is judged",
}
"""(fault, method) -> what the method is not told."""


def studies(effort: Effort, advance: Callable[[], None]) -> list[Grid]:
    """Return one table: faults and numbers of gauges down, methods across."""
    rows = []
    for gauges in COUNTS:
        if effort.quick and gauges not in QUICK_COUNTS:
            advance()
            continue
        counts_by_fault = {fault: [Counted() for _ in METHODS] for fault in FAULTS}
        seen: set[str] = set()  # faults that are wrong although their gauge shows in the residuals
        for finger in range(effort.pick(1, 2)):
            with tempfile.TemporaryDirectory(prefix="tipforce-report-") as folder:
                rng = np.random.default_rng([effort.seed + 100 * finger + gauges, gauges])
                calibration = calibrated(Path(folder), gauges, rng)  # once, by the command
                for fault, before in counts_by_fault.items():
                    scene = _scene(fault, gauges, effort.pick(4, 8), rng)
                    counts = _counts(Path(folder), scene, calibration)
                    if any(map(_is_wrong, counts)) and not _is_hidden(scene, calibration):
                        seen.add(fault)
                    before[:] = [a + b for a, b in zip(before, counts, strict=True)]
        rows += [_row(fault, gauges, tuple(counts), fault not in seen) for fault, counts in counts_by_fault.items()]
        advance()
    return [
        Grid(
            "honesty", "Wrong values shown as ok: P off by more than five of its own standard uncertainties",
            "fault, gauges", METHODS, tuple(rows), _remarks(rows),
        )
    ]  # fmt: skip


def _is_hidden(scene: schema.Scene, calibration: Calibration) -> bool:
    """Whether the gauge of the scene's fault shows too little in the residuals for its fault to be judged."""
    if calibration.C.shape[1] == 3:
        return True
    model = parity(calibration.C, calibration.covariance_strain2)
    shares = model.visible * np.diag(calibration.covariance_strain2)
    return any(fault.gauge is not None and shares[fault.gauge - 1] < LEAST_SHARE for fault in scene.faults)


def _row(fault: str, gauges: int, counts: tuple[Counted, ...], hidden: bool = False) -> GridRow:
    cannot = CANNOT_TELL.get((fault, gauges), "") or (_HIDDEN if hidden and fault in KINDS else "")
    over, known = tuple(map(_is_wrong, counts)), [NOT_TOLD.get((fault, method), "") or cannot for method in METHODS]
    reasons = tuple(reason if wrong else "" for reason, wrong in zip(known, over, strict=True))
    return GridRow(f"{fault}, {gauges}", counts, reasons, over)


def _is_wrong(count: Counted) -> bool:
    """Whether more rows are wrong than allowed; one alone may be chance."""
    return count.wrong > max(1.0, ALLOWED_WRONG_SHARE * count.ok)


def _remarks(rows: list[GridRow]) -> tuple[str, ...]:
    sums, least = sums_of(METHODS, rows)
    clean = sum((cell for row in rows if row.name.startswith("none") for cell in row.cells), Counted())
    shown = "; ".join(f"{name} {cell.wrong} of {cell.ok}" for name, cell in sums.items())
    return (
        f"Wrong among the rows shown as ok, over all faults: {shown}.",
        f"Fewest: {least}.",
        f"Fingers without a fault are shown as ok in {100.0 * clean.ok / max(clean.rows, 1):.1f} % of the rows.",
        "tipforce read, hand and view show the node's values; the exported C judges as the node (tests/export_c).",
    )


def calibrated(folder: Path, gauges: int, rng: np.random.Generator) -> Calibration:
    """Return what `tipforce calibrate fit` writes for the 19 grooves with three weights, in ``folder``/cal.toml."""
    A, grooves = strain_matrix(FABRICATED, GAUGES[:gauges]), paper_grooves()
    rows: list[list[float]] = []
    for phi, theta in zip(grooves.phi_rad, grooves.theta_rad, strict=True):
        for P in (1.1, 2.2, LARGEST_NEWTONS, 0.0):
            V = 1e6 * force_vector(P, phi, theta) @ A.T + NOISE_MICROSTRAIN * rng.normal(size=gauges)
            rows.append([10.0 * len(rows), *np.round(V, 1), P, math.degrees(phi), math.degrees(theta), COLD_DEGC])
    table, path = folder / "grooves.csv", folder / "cal.toml"
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [f"SG{k + 1}" for k in range(gauges)]
        writer.writerow(["t_s", *names, "P_N", "phi_deg", "theta_deg", "temperature_degC"])
        writer.writerows(rows)
    words = ["calibrate", "fit", str(table), "-o", str(path), "--saturation", "3276.7", "--sense", "push"]
    command = [sys.executable, "-m", "tipforce_tools.cli.main", *words, "--date", "2026-01-31"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = f"exit code {done.returncode}: {(done.stdout + done.stderr)[-300:]}"
        raise tipforce.TipforceError(f"calibrate fit of simulated grooves: {reason}")
    return read_calibration(path, with_fit=True)


def _scene(fault: str, gauges: int, seconds: float, rng: np.random.Generator) -> schema.Scene:
    largest = 3.0 * LARGEST_NEWTONS if fault == "overload" else LARGEST_NEWTONS
    least = LARGEST_NEWTONS if fault == "overload" else 0.3
    knots = int(2.0 * seconds) + 1
    t, P, theta = np.linspace(0.0, seconds, knots), rng.uniform(least, largest, knots), rng.uniform(10.0, 170.0, knots)
    phi = theta + rng.uniform(-45.0, 45.0, knots) - 180.0
    if fault == "vibration":  # steps, after which the tip rings
        t, P, phi, theta = np.repeat(t, 2)[1:], *(np.repeat(values, 2)[:-1] for values in (P, phi, theta))
    load = schema.History(
        t_s=tuple(t.tolist()), P_N=tuple(P.tolist()), phi_deg=tuple(phi.tolist()), theta_deg=tuple(theta.tolist())
    )
    injected: tuple[schema.Fault, ...] = ()
    for kind in (kind for kind in KINDS if kind == fault):
        gauge = int(rng.integers(gauges)) + 1
        per_s = 50.0 * float(rng.choice([-1.0, 1.0])) if fault == "drift" else 0.0
        injected = (schema.Fault(kind=kind, nodes=(NODE_ID,), at_s=FAULT_FROM * seconds, gauge=gauge,
                                 microstrain_per_s=per_s),)  # fmt: skip
    front_end = schema.FrontEnd(
        temperature_degC=WARM_DEGC if fault == "warm" else COLD_DEGC,
        apparent_microstrain_per_degC=tuple(np.round(3.0 * rng.normal(size=gauges), 3).tolist()),
        gain_drift_ppm_per_degC=300.0,
    )
    return schema.Scene(
        duration_s=seconds, sync_hz=SYNC_HZ, seed=int(rng.integers(1 << 30)),
        nodes=(schema.Nodes(ids=(NODE_ID,), pdos=("gauges", "contact", "health"), layout=GAUGES[:gauges],
                            calibration="cal.toml"),),
        loads=(load,), faults=injected, front_end=front_end,
        noise=schema.Noise(gauge_microstrain=NOISE_MICROSTRAIN,
                           one_over_f_microstrain=5.0 if fault == "1/f noise" else None),
        dynamics=schema.Dynamics() if fault == "vibration" else None,
    )  # fmt: skip


# What the node had at each SYNC: P with the standard uncertainty as the node computes it, NaN where it says unknown;
# status 2120h, faults 2124h; (n,) microstrain as sent.
_Samples = npt.NDArray[np.void]
_SAMPLE = [(name, float) for name in ("t_s", "P_newtons", "u_P_newtons", "degC")] + [("status", int), ("faults", int)]


def _counts(folder: Path, scene: schema.Scene, calibration: Calibration) -> list[Counted]:
    (finger,) = build(scene, folder)
    application = finger.device.application
    assert isinstance(application, Fingertip)
    rows: list[tuple[Any, ...]] = []

    def keep(t_us: int, can_id: int, _data: bytes) -> None:
        if can_id == codes.TPDO_BASES[0] + NODE_ID:  # the first PDO of the sample; its values are those of the wire
            sample = application.sample
            hidden = sample.unknown() & scalar.UNKNOWN_FORCE
            P = math.nan if hidden else round(sample.contact()[0], 3)
            temperature = math.nan if sample.reading is None else sample.reading.temperature / 100.0
            rows.append((1e-6 * t_us, P, sample.uncertainty()[0], temperature, sample.status(), sample.faults,
                         tuple(round(value, 1) for value in sample.microstrains)))  # fmt: skip

    simulate(scene, [finger], scene.duration_s, keep, lambda _t_us: None)
    samples = np.array(rows, dtype=[*_SAMPLE, ("microstrain", float, (finger.gauges,))])
    true = applied_at(scene.load(NODE_ID), samples["t_s"])[:, 0]
    counts = []
    for P, u, ok in _shown(samples, calibration):
        wrong = ok & ~(np.abs(P - true) <= TOO_FAR * u)
        counts.append(Counted(len(true), int(ok.sum()), int(wrong.sum())))
    return counts


def _shown(samples: _Samples, calibration: Calibration) -> Iterator[tuple[FloatArray, FloatArray, BoolArray]]:
    P, u = samples["P_newtons"], samples["u_P_newtons"]
    alone = np.isfinite(P) & (samples["status"] == scalar.CONTACT_PRESENT | scalar.CALIBRATED)
    yield P, u, alone
    yield P, u, alone & (samples["faults"] == 0)
    yield _decoded(samples, calibration)
    for temperature in (samples["degC"], None):
        estimated = tipforce.estimate(calibration, samples["microstrain"], temperature_degC=temperature)
        yield estimated.P_newtons, estimated.u_P_newtons, says_ok(estimated)


def says_ok(estimated: tipforce.Contacts) -> BoolArray:
    """Return which rows have a known P and no flag but those of the contact itself."""
    flagged = estimated.status & ~np.uint16(Status.CONTACT | Status.CALIBRATED)
    ok: BoolArray = np.isfinite(estimated.P_newtons) & (flagged == 0) & estimated.has(Status.CONTACT)
    return ok


def _decoded(samples: _Samples, calibration: Calibration) -> tuple[FloatArray, FloatArray, BoolArray]:
    k, microstrain = len(samples), samples["microstrain"].T
    columns = [computed(f"SG{gauge}", "microstrain", 1) for gauge in range(1, len(microstrain) + 1)]
    values = {column.name: strain for column, strain in zip(columns, microstrain, strict=True)}
    for name, bit in (("stale", scalar.STALE), ("fault", scalar.FRONT_END_FAULT), ("saturated", scalar.SATURATED)):
        columns.append(flag(name))
        values[name] = (samples["status"] & bit != 0).astype(np.int8)
    columns.append(computed("temperature", ""))
    values["temperature"] = samples["degC"]
    table = Table(
        (1e9 * samples["t_s"]).astype(np.int64), np.full(k, NODE_ID, np.uint16), np.arange(k), np.ones(k, np.bool_),
        tuple(columns), values,
    )  # fmt: skip
    (decoded,) = ContactColumns({None: calibration}, None).tables([table])
    P, u = decoded.values["P_N"], decoded.values["u_P_N"]
    doubts = [decoded.values[name] == 1 for name in FLAGS if name != "contact"]
    ok = np.isfinite(P) & (decoded.values["contact"] == 1) & ~np.any(doubts, axis=0)
    return P, u, ok
