"""How often do nominal 95 % intervals of P, phi, theta hold the truth? The command of coverage_study.py.

python -m bench.coverage                       the full study as text (some minutes)
python -m bench.coverage --markdown            the tables of docs/uncertainty.md
python -m bench.coverage --json                JSON lines, one a cell
python -m bench.coverage -o FILE.png           a plot, .png or .svg
python -m bench.coverage --quick               a tenth of the trials
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from math import isnan

import numpy as np
from bench.coverage_study import (
    DELTAS_DEG,
    FULL_TRIALS,
    NOMINAL,
    QUICK_TRIALS,
    SEED,
    SNRS,
    TOLERANCE_PERCENT,
    Cell,
    failures,
    study,
    without_the_one,
)
from bench.printed import table

ISOTROPIC = "isotropic noise"
QUANTITIES = ("P", "phi", "theta")


def shown(cells: list[Cell], quantity: int) -> str:
    """The percentage furthest from nominal among the layouts; a star where first order does not hold in all."""
    percents = [(c.P_percent, c.phi_percent, c.theta_percent)[quantity] for c in cells]
    worst = max(percents, key=lambda percent: abs(percent - 100.0 * NOMINAL))
    return f"{worst:.1f}" + ("" if all(c.holds[quantity] for c in cells) else "*")


def scenario_table(cells: list[Cell], markdown: bool) -> str:
    """One scenario: a row per SNR, a column per delta, each "P / phi / theta"."""
    rows = []
    for snr in SNRS:
        row = [str(snr)]
        for delta_deg in DELTAS_DEG:
            here = [c for c in cells if c.snr == snr and c.delta_deg == delta_deg]
            row.append(" / ".join(shown(here, quantity) for quantity in range(3)))
        rows.append(row)
    return table(["SNR", *(f"delta {delta}" for delta in DELTAS_DEG)], rows, markdown)


def flag_table(cells: list[Cell], markdown: bool) -> str:
    """Isotropic noise: readings flagged by their own criterion, by the status, and not covered yet not flagged."""
    rows = []
    for snr in SNRS:
        here = {c.delta_deg: c for c in cells if c.scenario == ISOTROPIC and c.snr == snr}
        found = [here[delta] for delta in DELTAS_DEG]
        rows.append(
            [str(snr), *(f"{c.flagged_percent:.0f} / {c.status_percent:.1f} / {c.silent_percent:.1f}" for c in found)]
        )
    return table(["SNR", *(f"delta {delta}" for delta in DELTAS_DEG)], rows, markdown)


def bias_line(cells: list[Cell]) -> str:
    """The bias of P where it stands out of the noise of the simulation and first order holds."""
    found = [c.bias_P for c in cells if np.isfinite(c.bias_P) and all(c.holds) and c.scenario == "C known"]
    if not found:
        return "Bias of P: below what this many trials can show."
    return (
        f"Bias of P over s^2 / 2P (1 expected; C known, SNR 10, where first order holds): "
        f"{min(found):.2f} to {max(found):.2f}, mean {np.mean(found):.2f}."
    )


def one_table(rows: list[dict[str, float | str]], markdown: bool) -> str:
    """Coverage with and without the 1 in G."""
    header = ["grooves to", "reading", "P with 1", "P without", "theta with 1", "theta without", "ratio: mean", "max"]
    body = [
        [
            f"{row['grooves_to_deg']:.0f}",
            str(row["sense"]),
            *(f"{row[key]:.1f}" for key in ("P_percent_with", "P_percent_without")),
            *(f"{row[key]:.1f}" for key in ("theta_percent_with", "theta_percent_without")),
            *(f"{row[key]:.1f}" for key in ("leverage_ratio", "leverage_ratio_max")),
        ]
        for row in rows
    ]
    return table(header, body, markdown)


def report(cells: list[Cell], one: list[dict[str, float | str]], trials: int, markdown: bool) -> str:
    """All tables with their captions."""
    title = "### {}" if markdown else "{}"
    parts = []
    for scenario in dict.fromkeys(c.scenario for c in cells):
        here = [c for c in cells if c.scenario == scenario]
        of = "" if scenario == ISOTROPIC else f", the worst of cases {', '.join(dict.fromkeys(c.layout for c in here))}"
        parts += [title.format(f"{scenario[0].upper()}{scenario[1:]}{of}"), scenario_table(here, markdown)]
    parts += [
        title.format("Flags: readings' own criterion / status bit 4 or 5 / silent misses of theta, % (isotropic)")
    ]
    parts += [flag_table(cells, markdown), bias_line(cells)]
    parts += [title.format("The 1 in G: case I, SNR 100, delta 30"), one_table(one, markdown)]
    silent = max(c.silent_percent for c in cells)
    parts += [
        f"{len(cells)} cells of {trials} trials. Largest share of readings in any cell whose interval of theta misses "
        f"the truth without a flag: {silent:.1f} %."
    ]
    bad = failures(cells)
    parts += bad or [f"Within {TOLERANCE_PERCENT:g} points of {100 * NOMINAL:g} % wherever first order holds."]
    return "\n\n".join(parts)


def plot(cells: list[Cell], path: str) -> None:
    """Coverage of P, phi, theta against delta, one line per scenario, the worst of the layouts and SNRs apart."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, len(SNRS), figsize=(13, 8), sharex=True, sharey=True, layout="constrained")
    for column, snr in enumerate(SNRS):
        for row, quantity in enumerate(QUANTITIES):
            ax = axes[row, column]
            ax.axhspan(93, 97, color="0.92")
            ax.axhline(95, color="0.6", lw=0.8)
            for scenario in dict.fromkeys(c.scenario for c in cells):
                here = [c for c in cells if c.scenario == scenario and c.snr == snr]
                _plot_line(ax, here, row, scenario)
            if row == 0:
                ax.set_title(f"SNR {snr}")
            if column == 0:
                ax.set_ylabel(f"{quantity}: coverage, %")
    for ax in axes[-1]:
        ax.set_xlabel("|delta|, degrees")
    axes[0, -1].legend(fontsize=7, loc="lower left")
    figure.suptitle("Coverage of nominal 95 % intervals; hollow: flagged, first order does not hold")
    figure.savefig(path, dpi=110, metadata={"Date": None} if path.endswith(".svg") else None)
    plt.close(figure)


def _plot_line(ax: object, cells: list[Cell], quantity: int, label: str) -> None:
    points = [(c.delta_deg, (c.P_percent, c.phi_percent, c.theta_percent)[quantity], c.holds[quantity]) for c in cells]
    points.sort()
    layouts = len({c.layout for c in cells})
    middle = [points[k : k + layouts] for k in range(0, len(points), layouts)]
    x = [group[0][0] for group in middle]
    y = [float(np.mean([point[1] for point in group])) for group in middle]
    (line,) = ax.plot(x, y, lw=0.9, label=label)  # type: ignore[attr-defined]
    for group, height in zip(middle, y, strict=True):
        face = line.get_color() if all(point[2] for point in group) else "white"
        ax.plot(group[0][0], height, "o", ms=4, color=line.get_color(), mfc=face)  # type: ignore[attr-defined]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the trials")
    parser.add_argument("--json", action="store_true", help="JSON lines, one a cell")
    parser.add_argument("--markdown", action="store_true", help="the tables of docs/uncertainty.md")
    parser.add_argument("-o", "--output", metavar="FILE", help="a plot, .png or .svg")
    args = parser.parse_args()
    trials = QUICK_TRIALS if args.quick else FULL_TRIALS
    cells = study(trials)
    if args.output:
        plot(cells, args.output)
    if args.json:
        for found in cells:
            record = asdict(found)
            print(
                json.dumps(
                    {key: None if isinstance(value, float) and isnan(value) else value for key, value in record.items()}
                )
            )
        return
    print(report(cells, without_the_one(np.random.default_rng(SEED + 1), trials), trials, args.markdown))


if __name__ == "__main__":
    main()
