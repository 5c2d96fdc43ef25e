"""The plot of `tipforce budget`: one stacked bar per quantity."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tipforce.errors import EnvironmentLackError, InputError

if TYPE_CHECKING:
    from tipforce.sensor.design.error_budget import Budget

_QUANTITIES = (("P", "N", 1.0), ("phi", "deg", 180.0 / np.pi), ("theta", "deg", 180.0 / np.pi))


def plot(found: Budget, path: str) -> None:
    """Write shares of the variance as stacked bars, .png or .svg. Raises InputError if the file cannot be written."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise EnvironmentLackError("a plot needs matplotlib: pip install 'tipforce[plot]'") from None
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
    totals = np.mean(found.total.uncertainties**2, axis=0)
    left = np.zeros(3)
    colours = plt.get_cmap("tab20").colors  # type: ignore[attr-defined]
    # Near tangency the shares of theta do not add up to one: the bar then does not end at the total.
    for number, row in enumerate(found.rows):
        share = 100.0 * np.mean(row.uncertainties**2, axis=0) / np.where(totals > 0.0, totals, 1.0)
        ax.barh(range(3), share, left=left, color=colours[number % len(colours)], label=row.cause)
        left = left + share
    labels = [
        f"{name}: {np.sqrt(total) * unit:.3g} {symbol}"
        for (name, symbol, unit), total in zip(_QUANTITIES, totals, strict=True)
    ]
    ax.set_yticks(range(3), labels)
    ax.invert_yaxis()
    ax.set_xlabel("share of the variance, %")
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    try:
        figure.savefig(path, dpi=120, metadata={"Date": None} if path.lower().endswith(".svg") else None)
    except OSError as error:
        raise InputError(f"--output {path}: {error.strerror}") from None
    finally:
        plt.close(figure)
