"""Five gauges: how large must a fault be to be detected, and to be traced to its gauge?

    python -m bench.fault_detection                 the tables of docs/uncertainty.md
    python -m bench.fault_detection -o FILE.png     a plot, .png or .svg

Single readings of gauges with equal noise, under pushes all over the pad. A fault is an offset (strain that jumps), a
gauge stuck at its unloaded reading, or a gain (part of the strain is lost)."""

from dataclasses import dataclass

import numpy as np
from bench.measure import arguments, table

from tipforce.arrays import FloatArray
from tipforce.output_file import save_figure
from tipforce.sensor.contact.estimate import force_vector
from tipforce.sensor.contact.redundancy import UNCLEAR, Parity, detect, detectable_strain, parity, weighted_inverse
from tipforce.sensor.contact.scalar_redundancy import leave_out
from tipforce.sensor.structure.quality import noise_gain
from tipforce.sensor.structure.strain import FABRICATED, GaugePosition, position_matrix

SIGMA = 1e-6
FALSE_ALARM_RATE, EXCLUSION_RATE = 1e-3, 1e-2
TRIALS, SEED = 50_000, 30
P_NEWTONS = 4.4
CALIBRATION_ROWS = 76

CASE_I = [GaugePosition("H", "left", 0.0), GaugePosition("H", "right", 0.0), GaugePosition("V", "right", 15e-3)]
FIVE = dict(zip("KSU", CASE_I, strict=True)) | {
    "L": GaugePosition("H", "left", 15e-3),
    "V5": GaugePosition("V", "left", 5e-3),
}
"""Case I, the point L, and a gauge on the other face of the vertical beam 5 mm from the joint."""
SIX = FIVE | {"V10": GaugePosition("V", "left", 10e-3)}
SIZES: dict[str, tuple[float, ...]] = {
    "offset, microstrain": (2, 5, 10, 20, 50, 100, 200),
    "stuck, load in N": (0.05, 0.1, 0.2, 0.5, 1, 2, 4.4),
    "gain, % at 4.4 N": (0.5, 1, 2, 5, 10, 20, 50),
}


@dataclass(frozen=True, slots=True)
class Rate:
    """One gauge, one kind and size of fault; percentages of the trials."""

    gauges: int
    kind: str
    size: float
    gauge: str
    detected: float
    isolated: float  # the right gauge named, alone
    wrong: float  # another gauge named, alone
    among: float  # the right gauge among those that cannot be told apart, of the detected ones


def pushes(rng: np.random.Generator, count: int, P_newtons: float) -> FloatArray:
    """Forces of pushes all over the pad, up to 45 degrees off the normal: (count, 3)."""
    theta = np.radians(rng.uniform(5.0, 175.0, count))
    return force_vector(P_newtons, theta + np.pi + np.radians(rng.uniform(-45.0, 45.0, count)), theta)


def readings(rng: np.random.Generator, A: FloatArray, kind: str, size: float, gauge: int, trials: int) -> FloatArray:
    """Strain (trials, n) with the fault in one gauge."""
    F = pushes(rng, trials, size if kind.startswith("stuck") else P_NEWTONS)
    V = F @ A.T + SIGMA * rng.normal(size=(trials, len(A)))
    if kind.startswith("offset"):
        V[:, gauge] += size * 1e-6
    elif kind.startswith("stuck"):
        V[:, gauge] = SIGMA * rng.normal()
    else:
        V[:, gauge] -= 0.01 * size * (F @ A[gauge])
    return V


def rates(positions: dict[str, GaugePosition], trials: int) -> list[Rate]:
    rng = np.random.default_rng(SEED)
    A = position_matrix(FABRICATED, list(positions.values()))
    covariance = SIGMA**2 * np.eye(len(A))
    model = parity(weighted_inverse(A, covariance), covariance)
    results = []
    for kind, sizes in SIZES.items():
        for size in sizes:
            for gauge, name in enumerate(positions):
                V = readings(rng, A, kind, size, gauge, trials)
                faults = detect(model, V, false_alarm_rate=FALSE_ALARM_RATE, exclusion_rate=EXCLUSION_RATE)
                right = faults.isolated == gauge
                wrong = faults.fault & ~right & (faults.isolated != UNCLEAR)
                detected = float(np.mean(faults.fault))
                among = float(np.mean(faults.candidates[:, gauge])) / detected if detected else 0.0
                shares = (detected, float(np.mean(right)), float(np.mean(wrong)), among)
                results.append(Rate(len(A), kind, size, name, *(100.0 * share for share in shares)))
    return results


def false_alarms(trials: int, seed: int = SEED) -> dict[str, float]:
    """Rates of alarms without a fault, in percent, five gauges, C known and C calibrated."""
    rng = np.random.default_rng(seed)
    A = position_matrix(FABRICATED, list(FIVE.values()))
    covariance = SIGMA**2 * np.eye(5)
    alarms = {"C known": 0.0, "C calibrated": 0.0, "C calibrated, as if known": 0.0}
    batch, batches = 50, 20 * trials // 50  # readings per calibration, and calibrations
    model = parity(weighted_inverse(A, covariance), covariance)
    for _ in range(batches):
        F = pushes(rng, batch, P_NEWTONS)
        V = F @ A.T + SIGMA * rng.normal(size=(batch, 5))
        loads = np.vstack([pushes(rng, CALIBRATION_ROWS, P_NEWTONS), np.zeros((19, 3))])
        G = np.column_stack([loads, np.ones(len(loads))])
        N = G.T @ G
        B = np.linalg.solve(N, G.T @ (G @ np.column_stack([A, np.zeros(5)]).T + SIGMA * rng.normal(size=(len(G), 5))))
        own = parity(weighted_inverse(B[:3].T, covariance), covariance)
        g = np.column_stack([F, np.ones(batch)])
        factor = 1.0 + np.einsum("ti,ij,tj->t", g, np.linalg.inv(N), g)
        for name, judge, strain, variance in (
            ("C known", model, V, np.ones(batch)),
            ("C calibrated", own, V - B[3], factor),
            ("C calibrated, as if known", own, V - B[3], np.ones(batch)),
        ):
            faults = detect(judge, strain, false_alarm_rate=FALSE_ALARM_RATE, variance_factor=variance)
            alarms[name] += float(np.sum(faults.fault))
    return {name: 100.0 * count / (batch * batches) for name, count in alarms.items()}


def weights(calibrations: int) -> dict[str, tuple[float, float]]:
    """What it costs to weigh C by one covariance and store another: (false alarms %, RMS error of F without U, N).

    Five gauges of equal independent noise, whose covariance each calibration estimates from its residuals."""
    rng = np.random.default_rng(SEED)
    A, batch = position_matrix(FABRICATED, list(FIVE.values())), 200
    names = ("variances, full covariance stored", "variances, variances stored", "full covariance, the same stored")
    results: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for _ in range(calibrations):
        loads = np.vstack([pushes(rng, CALIBRATION_ROWS - 19, P_NEWTONS), np.zeros((19, 3))])
        G = np.column_stack([loads, np.ones(len(loads))])
        V = loads @ A.T + SIGMA * rng.normal(size=(len(G), 5))
        B = np.linalg.solve(G.T @ G, G.T @ V)
        residual = V - G @ B
        full = residual.T @ residual / (len(G) - 4)
        diagonal = np.diag(np.diag(full))
        F = pushes(rng, batch, P_NEWTONS)
        strain = F @ A.T + SIGMA * rng.normal(size=(batch, 5)) - B[3]
        for name, weight, stored in zip(names, (diagonal, diagonal, full), (full, diagonal, full), strict=True):
            C = weighted_inverse(B[:3].T, weight)
            alarms = np.mean(detect(parity(C, stored), strain, false_alarm_rate=FALSE_ALARM_RATE).fault)
            left = leave_out(C.tolist(), stored[np.triu_indices(5)].tolist(), [2])
            error = np.inf if left is None else np.sqrt(np.mean((strain @ np.transpose(left[0]) - F) ** 2))
            results[name].append((100.0 * float(alarms), float(error)))
    mean = {name: np.sqrt(np.mean(np.square(pairs), axis=0)) for name, pairs in results.items()}
    return {name: (float(np.mean([a for a, _ in results[name]])), float(mean[name][1])) for name in names}


def separation(model: Parity) -> FloatArray:
    """The sine of the angle between the parity directions of each two gauges (n, n); NaN of invisible ones.

    0: the two cannot be distinguished. Small: only by a fault larger by 1 / sine than the smallest visible one."""
    length = np.sqrt(np.where(model.visible > 0.0, model.visible, np.nan))
    cosine = (model.W / length).T @ (model.W / length)
    sine: FloatArray = np.sqrt(np.clip((1.0 - cosine) * (1.0 + cosine), 0.0, None))
    return sine


def alike(model: Parity, smallest_sine: float = 1e-6) -> list[tuple[int, int]]:
    """The pairs of gauges that no fault up to 1 / smallest_sine of the smallest visible one distinguishes."""
    sine = separation(model)
    n = len(sine)
    return [(i, k) for i in range(n) for k in range(i + 1, n) if sine[i, k] < smallest_sine]


def layout_table(positions: dict[str, GaugePosition]) -> str:
    """Per gauge: what shows, whom it is confused with, and what its loss costs."""
    A = position_matrix(FABRICATED, list(positions.values()))
    covariance = SIGMA**2 * np.eye(len(A))
    C = weighted_inverse(A, covariance)
    model, names = parity(C, covariance), list(positions)
    detectable = detectable_strain(model, FALSE_ALARM_RATE) * 1e6
    pairs = alike(model, smallest_sine=0.05)
    rows = []
    for k, name in enumerate(names):
        twins = [names[i + j - k] for i, j in pairs if k in (i, j)]
        left = leave_out(C.tolist(), covariance[np.triu_indices(len(A))].tolist(), [k])
        gain = "no rank 3" if left is None else f"{noise_gain(left[0]) / noise_gain(C):.2f}"
        rows.append([name, f"{detectable[k]:.1f}", ", ".join(twins) or "none", gain])
    return table(
        ["gauge", "smallest detected, microstrain", "not distinguished from", "noise of F without it, times"], rows
    )


def rate_table(results: list[Rate], kind: str) -> str:
    here = [rate for rate in results if rate.kind == kind]
    names = list(dict.fromkeys(rate.gauge for rate in here))
    rows = []
    for size in SIZES[kind]:
        row = {rate.gauge: rate for rate in here if rate.size == size}
        shown = (f"{row[n].detected:.1f} / {row[n].isolated:.1f} / {row[n].wrong:.1f}" for n in names)
        rows.append([f"{size:g}", *shown])
    return table([kind, *names], rows)


def report(
    results: dict[int, list[Rate]], alarms: dict[str, float], weighed: dict[str, tuple[float, float]], trials: int
) -> str:
    among = min(rate.among for rate in results[5] if rate.detected > 50.0)
    rows = [[name, f"{alarm:.2f}", f"{error:.4f}"] for name, (alarm, error) in weighed.items()]
    return "\n\n".join([
        "### Five gauges: smallest fault, and cost of a loss", layout_table(FIVE),
        "### Five gauges: detected / isolated / wrongly isolated, %", *(rate_table(results[5], kind) for kind in SIZES),
        "### Six gauges, three on each beam", layout_table(SIX), rate_table(results[6], "offset, microstrain"),
        "### Five gauges: C weighted by one covariance, and which one the record holds",
        table(["C weighted by", "false alarms, %", "RMS error of F without U, N"], rows),
        f"{trials} trials per rate, gauge noise 1 microstrain, false alarms set to {100 * FALSE_ALARM_RATE:g} %, "
        f"exclusion to {100 * EXCLUSION_RATE:g} %. The faulty gauge is among those named in at least {among:.1f} % of "
        "the readings where a fault is detected (rates above 50 %).",
        f"False alarms over {20 * trials} readings: "
        + ", ".join(f"{name} {percent:.3f} %" for name, percent in alarms.items()) + ".",
    ])  # fmt: skip


def plot(results: list[Rate], path: str) -> None:
    """Detection and isolation against fault size, one panel per kind, one colour per gauge."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, len(SIZES), sharey=True)
    for ax, kind in zip(axes, SIZES, strict=True):
        here = [rate for rate in results if rate.kind == kind]
        for number, name in enumerate(dict.fromkeys(rate.gauge for rate in here)):
            mine = [rate for rate in here if rate.gauge == name]
            sizes = [rate.size for rate in mine]
            ax.plot(sizes, [rate.detected for rate in mine], "-o", ms=3, color=f"C{number}", label=name)
            ax.plot(sizes, [rate.isolated for rate in mine], "--", color=f"C{number}")
        ax.set(xscale="log", xlabel=kind)
    axes[0].set_ylabel("% of readings")
    axes[0].legend(title="solid: detected\ndashed: isolated", fontsize=8)
    save_figure(figure, path, dpi=110)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("-o", "--output", metavar="FILE", help="a plot, .png or .svg")
    output, by_gauges = parser.parse_args().output, {5: rates(FIVE, TRIALS), 6: rates(SIX, TRIALS)}
    if output:
        plot(by_gauges[5], output)
    print(report(by_gauges, false_alarms(TRIALS), weights(TRIALS // 100), TRIALS))


if __name__ == "__main__":
    main()
