"""The plot of `tipforce budget`: for each quantity a bar per cause, named and with its value."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tipforce.output_file import save_figure
from tipforce_lab import plotting as figures

if TYPE_CHECKING:
    from tipforce_lab.design.error_budget import Budget

_QUANTITIES = (("P", "N", 1.0), ("phi", "deg", 180.0 / np.pi), ("theta", "deg", 180.0 / np.pi))
_BAR, _TOTAL = "#0072b2", "#222222"


def plot(found: Budget, path: str) -> None:
    """Draw the standard uncertainty of each cause, root mean square over the loads, .png or .svg.

    Sorted by share of the variance of P; one colour, so that print and any colour vision show the same. Raises
    EnvironmentLackError without matplotlib, and InputError if the file cannot be written.
    """
    sizes = np.array([np.sqrt(np.mean(row.uncertainties**2, axis=0)) for row in found.rows])
    total = np.sqrt(np.mean(found.total.uncertainties**2, axis=0))
    order = np.argsort(-sizes[:, 0], kind="stable")
    names = [found.rows[k].cause for k in order] + ["total"]
    with figures.plotting({"font.size": 9.0}):
        figure = figures.new_figure(9.0, 0.9 + 0.27 * len(names))
        panels = figure.subplots(1, 3, sharey=True)
        for k, (axes, (name, symbol, unit)) in enumerate(zip(panels, _QUANTITIES, strict=True)):
            values = unit * np.append(sizes[order, k], total[k])
            places = np.arange(len(values), dtype=np.float64)
            axes.barh(places, values, color=[_BAR] * len(order) + [_TOTAL], height=0.7)
            for place, value in zip(places, values, strict=True):
                told = f"{value:#.2g}" if value > 1e-6 * total[k] * unit else "0"  # below: rounding
                axes.annotate(told, (value, place), (3, 0), textcoords="offset points", va="center")
            axes.set(xlabel=f"u({name}) ({symbol})", xlim=(0.0, 1.22 * max(values.max(), 1e-300)))
            axes.grid(visible=False)
            axes.tick_params(axis="y", length=0)
        panels[0].set_yticks(range(len(names)), names)
        panels[0].invert_yaxis()
        save_figure(figure, path, dpi=130)
