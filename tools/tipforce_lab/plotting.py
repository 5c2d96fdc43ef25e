"""matplotlib set up for small, reproducible files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tipforce.errors import needing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REPRODUCIBLE = {"svg.hashsalt": "tipforce", "svg.fonttype": "none"}
_PLAIN = {"axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False}


@contextmanager
def plotting(style: Mapping[str, Any], extra: str = "plot") -> Iterator[None]:
    """Apply a style of matplotlib settings. Raises EnvironmentLackError, which names ``extra``, without matplotlib."""
    with needing(f'figures need matplotlib, which is not installed: pip install "tipforce[{extra}]"'):
        import matplotlib
    settings: Any = {**_REPRODUCIBLE, **_PLAIN, "figure.constrained_layout.use": True, **style}
    with matplotlib.rc_context(settings):
        yield


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """Return a figure that is not attached to a window toolkit."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_inch, height_inch))
