"""matplotlib set up for small files that are the same for the same numbers, and how they are written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipforce.errors import EnvironmentLackError, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REPRODUCIBLE = {"svg.hashsalt": "tipforce", "svg.fonttype": "none"}
_PLAIN = {"axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False}


@contextmanager
def plotting(style: Mapping[str, Any], extra: str = "plot") -> Iterator[None]:
    """Draw in a style of matplotlib's settings. Raises EnvironmentLackError, which names ``extra``, without it."""
    try:
        import matplotlib
    except ImportError:
        lack = f'figures need matplotlib, which is not installed: pip install "tipforce[{extra}]"'
        raise EnvironmentLackError(lack) from None
    settings: Any = {**_REPRODUCIBLE, **_PLAIN, "figure.constrained_layout.use": True, **style}
    with matplotlib.rc_context(settings):
        yield


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """A figure that no window toolkit sees."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_inch, height_inch))


def save(figure: Figure, path: Path, **options: Any) -> None:
    """Write the figure without a date. Raises InputError for an unknown ending or a path that cannot be written."""
    if path.suffix not in (".svg", ".png"):
        raise InputError(f"figure {path}: allowed are the endings .svg and .png")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
        figure.savefig(path, metadata=metadata, **options)
    except OSError as error:
        raise InputError(f"figure {path}: {error.strerror}") from error
