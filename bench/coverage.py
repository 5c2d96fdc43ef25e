"""How often do nominal 95 % intervals of P, phi, theta hold the truth?

python -m bench.coverage                       the tables of docs/uncertainty.md (some minutes)
python -m bench.coverage -o FILE.png           a plot, .png or .svg"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import sqrt

import numpy as np
from bench.measure import arguments, table

from tipforce.arrays import FloatArray, IntArray
from tipforce.output_file import save_figure
from tipforce.sensor.calibration.simulation import paper_grooves
from tipforce.sensor.contact import estimate, scalar, validity
from tipforce.sensor.structure.quality import noise_gain
from tipforce.sensor.structure.strain import FABRICATED, calibration_matrix, strain_matrix
from tipforce_lab.design.error_budget import pad_loads

ISOTROPIC = "isotropic noise"
QUANTITIES = ("P", "phi", "theta")
NOMINAL = 0.95
NORMAL_FACTOR = 1.959963984540054
TOLERANCE_PERCENT = 2.0
P_NEWTONS = 4.4  # the paper's weight: readings and calibration loads alike
THETA_DEG = 85.0  # with |delta| up to 90 degrees the pulls then stay within the paper's 0 to 90 degrees of phi
SNRS = (10, 30, 100, 1000)
DELTAS_DEG = (0, 30, 60, 75, 85, 90)
REPEATS = 3  # readings per groove, and one unloaded reading per groove
FULL_TRIALS, QUICK_TRIALS, SEED = 40_000, 4_000, 20


@dataclass(frozen=True, slots=True)
class Cell:
    """One scenario at one SNR and one angle between force and surface normal; percentages of the trials."""

    scenario: str
    layout: str
    snr: int
    delta_deg: int
    percents: tuple[float, float, float]  # intervals of P, phi, theta that hold the truth
    holds: tuple[bool, bool, bool]  # first_order_holds() at the true load, for P, phi, theta
    flagged_percent: float  # readings whose own first_order_holds() is false for theta
    status_percent: float  # readings with bit 4 (theta unresolved) or 5 (misses the tip)
    silent_percent: float  # readings whose interval of theta misses the truth, with no flag


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Simulated calibrations, one a trial: V = A F + offset fitted to noisy rows."""

    C: FloatArray  # (trials, 3, 3)
    offset: FloatArray  # (trials, 3)
    S: FloatArray  # (trials, 3, 3), residual covariance
    N: FloatArray  # (4, 4), sum of G G^T, G = (F, 1)
    factor: float


def grooves(largest_theta_deg: float) -> FloatArray:
    """The pulls of the paper's grooves up to a contact angle: F of shape (m, 3), newtons."""
    paper = paper_grooves()
    inside = np.degrees(paper.theta_rad) <= largest_theta_deg + 1e-9
    return estimate.force_vector(P_NEWTONS, paper.phi_rad[inside], paper.theta_rad[inside])


def fits(rng: np.random.Generator, loads: FloatArray, A: FloatArray, sigma: float, trials: int) -> Fits:
    """Calibrate so many sensors by least squares with an offset, the gauges' noise being sigma (strain)."""
    from scipy.stats import t as student

    F = np.vstack([np.repeat(loads, REPEATS, axis=0), np.zeros((len(loads), 3))])
    G = np.column_stack([F, np.ones(len(F))])
    N, freedom = G.T @ G, len(G) - 4
    gain = G @ np.linalg.inv(N)
    B, S = np.empty((trials, 3, 4)), np.empty((trials, 3, 3))
    for start in range(0, trials, 4000):
        rows = slice(start, min(start + 4000, trials))
        noise = sigma * rng.normal(size=(rows.stop - start, 3, len(G)))
        error = noise @ gain
        residual = noise - error @ G.T
        B[rows] = np.column_stack([A, np.zeros(3)]) + error
        S[rows] = residual @ residual.transpose(0, 2, 1) / freedom
    C = np.asarray(np.linalg.inv(B[..., :3]), dtype=np.float64)
    return Fits(C, B[..., 3], S, N, float(student.ppf(0.5 + NOMINAL / 2.0, freedom)))


def true_load(delta_deg: float, pull: bool) -> tuple[FloatArray, float, float]:
    """(F, phi, theta): a pull at THETA_DEG leaning delta towards the x-axis, or the push opposite to it."""
    theta = np.radians(THETA_DEG)
    phi = theta - np.radians(delta_deg) - (0.0 if pull else np.pi)
    return estimate.force_vector(P_NEWTONS, phi, theta), float(phi), float(theta)


def cell(
    names: tuple[str, str, int, int], pull: bool, F: FloatArray, covariance: FloatArray, typical: FloatArray, k: float
) -> Cell:
    """Count one cell. F: (trials, 3) estimates; covariance: theirs; typical: (3, 3), for the true load."""
    true_F, phi, theta = true_load(names[3], pull)
    estimated, u = estimate.contacts(F, pull=pull), estimate.standard_uncertainties(F, covariance, pull=pull)
    off = estimated.phi_rad - phi, estimated.theta_rad - theta
    errors = estimated.P_newtons - P_NEWTONS, *(np.remainder(turn + np.pi, 2.0 * np.pi) - np.pi for turn in off)
    inside = np.abs(np.stack(errors, axis=-1)) <= k * u
    flagged = ~validity.first_order_holds(F, covariance)[:, 2]
    bits = status(estimated, u, miss_uncertainties(F, covariance), (0.0, 0.0, -180.0, 180.0))
    flagged_by_status = bits & (scalar.THETA_UNRESOLVED | scalar.MISSES_TIP) != 0
    silent = ~inside[:, 2] & ~flagged & ~flagged_by_status
    counted = [100.0 * float(np.mean(rows)) for rows in (flagged, flagged_by_status, silent)]
    holds = tuple(validity.first_order_holds(true_F, typical).tolist())
    return Cell(*names, tuple((100.0 * np.mean(inside, axis=0)).tolist()), holds, *counted)


def miss_uncertainties(F: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard uncertainty of |F2| - hypot(F1, F3), newtons (...), of F (..., 3), covariance (3, 3) or (..., 3, 3)."""
    elements = [covariance[..., i, j] for i in range(3) for j in range(i, 3)]
    return estimate.miss_deviation(estimate.forces(*np.moveaxis(F, -1, 0)), estimate.covariances(elements))


def status(
    contact: estimate.Contact,
    u: FloatArray,
    u_miss_newtons: FloatArray | float,
    limits: tuple[float, float, float, float],
    was_present: bool = False,
) -> IntArray:
    """Bits 0, 4, 5, 6 of contacts (n,) in time order, by their standard uncertainties u (n, 3) or (3,)."""
    least = scalar.MISS_COVERAGE_FACTOR * u_miss_newtons + scalar.MISS_FLOOR * contact.P_newtons
    resolved = validity.is_resolved(u[..., 0], u[..., 2])
    return validity.status_columns(contact, resolved, contact.miss_newtons > least, limits, was_present)


def known_matrix(rng: np.random.Generator, trials: int) -> Iterator[Cell]:
    """C and noise known: isotropic noise of F, and what equal gauges give in cases I to III."""
    matrices = {name: calibration_matrix(FABRICATED, name) for name in ("I", "II", "III")}
    for name, C in {"isotropic": np.eye(3), **matrices}.items():
        scenario = ISOTROPIC if name == "isotropic" else "C known"
        for snr in SNRS:
            root = C * (P_NEWTONS / snr * sqrt(3.0) / noise_gain(C))
            for delta_deg in DELTAS_DEG:
                F = true_load(delta_deg, True)[0] + rng.normal(size=(trials, 3)) @ root.T
                names = (scenario, name, snr, delta_deg)
                yield cell(names, True, F, root @ root.T, root @ root.T, NORMAL_FACTOR)


def estimates(
    rng: np.random.Generator, calibrated: Fits, A: FloatArray, sigma: float, true_F: FloatArray, with_one: bool = True
) -> tuple[FloatArray, FloatArray]:
    """(F, covariance) of one new reading per calibration: C S C^T (1 + G^T N^-1 G), G = (F, 1).

    with_one False leaves the 1 out of G and N, as if the offset were known: what the study shows to be wrong."""
    V = true_F @ A.T + sigma * rng.normal(size=calibrated.offset.shape)
    F: FloatArray = np.einsum("tij,tj->ti", calibrated.C, V - calibrated.offset)
    G = np.column_stack([F, np.ones(len(F))]) if with_one else F
    N = calibrated.N if with_one else calibrated.N[:3, :3]
    leverage = np.einsum("ti,ij,tj->t", G, np.linalg.inv(N), G)
    covariance = calibrated.C @ calibrated.S @ calibrated.C.transpose(0, 2, 1)
    return F, covariance * (1.0 + leverage)[:, np.newaxis, np.newaxis]


def calibrated_matrix(rng: np.random.Generator, trials: int) -> Iterator[Cell]:
    """C, offset and noise from pulls in the grooves: then pulls (inside the calibrated range) and pushes (outside)."""
    for largest_theta_deg in (90.0, 180.0):
        loads = grooves(largest_theta_deg)
        for layout in ("I", "II", "III"):
            A, C = strain_matrix(FABRICATED, layout), calibration_matrix(FABRICATED, layout)
            for snr in SNRS:
                sigma = P_NEWTONS / snr * sqrt(3.0) / noise_gain(C)
                calibrated = fits(rng, loads, A, sigma, trials)
                for pull in (True, False):
                    scenario = f"grooves to {largest_theta_deg:.0f} deg, {'pull' if pull else 'push'}"
                    for delta_deg in DELTAS_DEG:
                        true_F = true_load(delta_deg, pull)[0]
                        F, covariance = estimates(rng, calibrated, A, sigma, true_F)
                        G = np.append(true_F, 1.0)
                        typical = sigma**2 * C @ C.T * (1.0 + G @ np.linalg.solve(calibrated.N, G))
                        yield cell((scenario, layout, snr, delta_deg), pull, F, covariance, typical, calibrated.factor)


def without_the_one(rng: np.random.Generator, trials: int) -> list[dict[str, float | str]]:
    """What the offset's own uncertainty is worth: coverage with and without the 1 in G, case I, SNR 100.

    leverage_ratio is G^T N^-1 G over the same without the 1, on the mean and at worst over such loads all over the
    pad: how much too little variance the part gets that the calibration contributes."""
    A, C = strain_matrix(FABRICATED, "I"), calibration_matrix(FABRICATED, "I")
    sigma = P_NEWTONS / 100.0 * sqrt(3.0) / noise_gain(C)
    rows: list[dict[str, float | str]] = []
    for largest_theta_deg in (90.0, 180.0):
        calibrated = fits(rng, grooves(largest_theta_deg), A, sigma, trials)
        for pull in (True, False):
            true_F, _, _ = true_load(30.0, pull)
            row: dict[str, float | str] = {"grooves_to_deg": largest_theta_deg, "sense": "pull" if pull else "push"}
            for with_one in (True, False):
                F, covariance = estimates(rng, calibrated, A, sigma, true_F, with_one)
                counted = cell(("", "I", 100, 30), pull, F, covariance, covariance.mean(axis=0), calibrated.factor)
                key = "with" if with_one else "without"
                row[f"P_percent_{key}"], _, row[f"theta_percent_{key}"] = counted.percents
            ratio = leverage_ratio(calibrated.N, pad_loads(P_NEWTONS, 5.0, 175.0, pull=pull).F)
            row["leverage_ratio"], row["leverage_ratio_max"] = float(ratio.mean()), float(ratio.max())
            rows.append(row)
    return rows


def leverage_ratio(N: FloatArray, F: FloatArray) -> FloatArray:
    """G^T N^-1 G with G = (F, 1) over F^T N^-1 F with the 1 left out of N, (m,)."""
    G = np.column_stack([F, np.ones(len(F))])
    with_one = np.einsum("mi,mi->m", G, np.linalg.solve(N, G.T).T)
    return np.asarray(with_one / np.einsum("mi,mi->m", F, np.linalg.solve(N[:3, :3], F.T).T), dtype=np.float64)


def study(trials: int = FULL_TRIALS, seed: int = SEED) -> list[Cell]:
    rng = np.random.default_rng(seed)
    return [*known_matrix(rng, trials), *calibrated_matrix(rng, trials)]


def failures(cells: list[Cell], tolerance_percent: float = TOLERANCE_PERCENT) -> list[str]:
    """The cells where first order is said to hold and coverage is off by more than the tolerance."""
    return [
        f"{c.scenario}, {c.layout}, SNR {c.snr}, {c.delta_deg} deg: {name} {percent:.1f} %"
        for c in cells
        for name, percent, holds in zip(QUANTITIES, c.percents, c.holds, strict=True)
        if holds and abs(percent - 100.0 * NOMINAL) > tolerance_percent
    ]


def covered(cells: list[Cell]) -> str:
    """Of P / phi / theta the percentage furthest from nominal among the layouts; a star where first order fails."""
    texts = []
    for k in range(3):
        worst = max((c.percents[k] for c in cells), key=lambda percent: abs(percent - 100.0 * NOMINAL))
        texts.append(f"{worst:.1f}" + ("" if all(c.holds[k] for c in cells) else "*"))
    return " / ".join(texts)


def flags(cells: list[Cell]) -> str:
    """Readings flagged by their own criterion / by the status / not covered yet not flagged, of the one cell."""
    return f"{cells[0].flagged_percent:.0f} / {cells[0].status_percent:.1f} / {cells[0].silent_percent:.1f}"


def by_snr(cells: list[Cell], shown: Callable[[list[Cell]], str]) -> str:
    return table(["SNR", *(f"delta {delta}" for delta in DELTAS_DEG)], [
        [str(snr), *(shown([c for c in cells if (c.snr, c.delta_deg) == (snr, delta)]) for delta in DELTAS_DEG)]
        for snr in SNRS
    ])  # fmt: skip


def report(cells: list[Cell], one: list[dict[str, float | str]], trials: int) -> str:
    parts = []
    for scenario in dict.fromkeys(c.scenario for c in cells):
        here = [c for c in cells if c.scenario == scenario]
        of = "" if scenario == ISOTROPIC else f", the worst of cases {', '.join(dict.fromkeys(c.layout for c in here))}"
        parts += [f"### {scenario[0].upper()}{scenario[1:]}{of}", by_snr(here, covered)]
    isotropic = [c for c in cells if c.scenario == ISOTROPIC]
    ones = [[f"{value:.1f}" if isinstance(value, float) else value for value in row.values()] for row in one]
    silent = max(c.silent_percent for c in cells)
    parts += [
        "### Flags: readings' own criterion / status bit 4 or 5 / silent misses of theta, % (isotropic)",
        by_snr(isotropic, flags),
        "### The 1 in G: case I, SNR 100, delta 30", table([*one[0]], ones),
        f"{len(cells)} cells of {trials} trials. Largest share of readings in any cell whose interval of theta misses "
        f"the truth without a flag: {silent:.1f} %.",
    ]  # fmt: skip
    parts += failures(cells) or [
        f"Within {TOLERANCE_PERCENT:g} points of {100 * NOMINAL:g} % wherever first order holds."
    ]
    return "\n\n".join(parts)


def plot(cells: list[Cell], path: str) -> None:
    """Coverage of P, phi, theta against delta, one line per scenario, the worst of the layouts and SNRs apart."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.subplots(3, len(SNRS), sharex=True, sharey=True)
    for column, snr in enumerate(SNRS):
        for row, quantity in enumerate(QUANTITIES):
            ax = axes[row, column]
            ax.axhspan(93, 97, color="0.92")
            ax.axhline(95, color="0.6", lw=0.8)
            for scenario in dict.fromkeys(c.scenario for c in cells):
                here = [c for c in cells if c.scenario == scenario and c.snr == snr]
                by_delta = [[c for c in here if c.delta_deg == delta] for delta in DELTAS_DEG]
                y = [float(np.mean([c.percents[row] for c in group])) for group in by_delta]
                (line,) = ax.plot(DELTAS_DEG, y, lw=0.9, label=scenario)
                for delta, group, height in zip(DELTAS_DEG, by_delta, y, strict=True):
                    face = line.get_color() if all(c.holds[row] for c in group) else "white"
                    ax.plot(delta, height, "o", ms=4, color=line.get_color(), mfc=face)
            if row == 0:
                ax.set_title(f"SNR {snr}")
            if column == 0:
                ax.set_ylabel(f"{quantity}: coverage, %")
    for ax in axes[-1]:
        ax.set_xlabel("|delta|, degrees")
    axes[0, -1].legend(fontsize=7, loc="lower left")
    figure.suptitle("Coverage of nominal 95 % intervals; hollow: flagged, first order does not hold")
    save_figure(figure, path, dpi=110)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("-o", "--output", metavar="FILE", help="a plot, .png or .svg")
    args = parser.parse_args()
    cells = study()
    if args.output:
        plot(cells, args.output)
    print(report(cells, without_the_one(np.random.default_rng(SEED + 1), FULL_TRIALS), FULL_TRIALS))


if __name__ == "__main__":
    main()
