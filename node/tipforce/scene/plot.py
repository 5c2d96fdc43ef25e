"""Plot applied and estimated contact over time, finger by finger. The only part of a scene that needs matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tipforce.errors import EnvironmentLackError
from tipforce.output_file import FIGURES, save_figure
from tipforce.scene import schema
from tipforce.scene.results import Contact

_LABELS = ("P (N)", "phi (degree)", "theta (degree)")


def write_plot(
    path: str | Path, scene: schema.Scene, node_ids: Sequence[int], contacts: Mapping[int, Contact | None]
) -> None:
    """Plot one row of P, phi, theta per finger. Raises EnvironmentLackError without matplotlib, InputError for a file
    that cannot be written."""
    try:
        import matplotlib as mpl
    except ImportError:
        raise EnvironmentLackError("plot: matplotlib is not installed: pip install 'tipforce[plot]'") from None
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(node_ids), 3, figsize=(13.0, 2.2 * len(node_ids) + 1.0), sharex=True, squeeze=False, layout="constrained"
    )
    for row, node_id in zip(axes, node_ids, strict=True):
        contact = contacts[node_id]
        for k, one in enumerate(row):
            if contact is not None:
                applied = contact.applied[:, k].copy()
                if k:
                    applied[contact.applied[:, 0] <= 0.0] = float("nan")  # a direction without a force has no meaning
                one.plot(contact.t_s, applied, color="0.6", linewidth=3.0, label="applied")
                one.plot(contact.t_s, contact.estimated[:, k], color="C0", linewidth=0.8, label="estimated")
            one.set_ylabel(_LABELS[k])
            one.grid(alpha=0.3)
        row[0].set_title(f"node {node_id}", loc="left", fontsize=10)
    axes[0][0].legend(loc="best", fontsize=8)
    for one in axes[-1]:
        one.set_xlabel("t (s)")
    figure.suptitle(scene.title or "scene")
    try:
        save_figure(figure, path, FIGURES)
    finally:
        plt.close(figure)
