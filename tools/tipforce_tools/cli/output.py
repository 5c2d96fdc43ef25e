"""The standard streams of every command: each text passes here, and what could control a terminal is escaped.

Data in bytes (CSV, Parquet) goes to ``sys.stdout.buffer`` as it is. The colours of tables go to the stream below.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO, cast

from canopen_device.visible_text import visible_lines

if TYPE_CHECKING:
    from rich.console import Console


class VisibleStream:
    """A text stream that shows control characters as escapes; all else is that of the stream below."""

    def __init__(self, below: TextIO) -> None:
        self.below = below

    def write(self, text: str) -> int:
        """Write, and return the number of characters of ``text``."""
        self.below.write(visible_lines(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each line."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.below, name)


@contextmanager
def visible_streams() -> Iterator[None]:
    """Escape what the block writes to stdout and stderr."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast("TextIO", VisibleStream(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def terminal(stream: TextIO) -> TextIO:
    """Return the stream below, for the control sequences of a command's own: colours, a progress bar."""
    while isinstance(stream, VisibleStream):
        stream = stream.below
    return stream


def rich_console(stream: TextIO, **options: Any) -> Console:
    """Return a console of rich on the stream below: its colours pass, every text is escaped, and none is markup."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment
    from rich.text import Text

    class VisibleConsole(Console):
        def on_broken_pipe(self) -> None:  # rich's own exits with code 1; `| head` is not a failure
            raise BrokenPipeError

        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(visible_lines(text), **options | {"markup": False, "emoji": False})

        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
            for segment in super().render(renderable, options):
                yield segment if segment.control else Segment(visible_lines(segment.text), segment.style)

    return VisibleConsole(file=terminal(stream), **options)
