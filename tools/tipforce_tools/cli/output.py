"""The standard streams of every command: each text passes here, and what could control a terminal is escaped.

Data in bytes (CSV, Parquet) goes to ``sys.stdout.buffer`` as it is. The colours of tables go to the stream below.
"""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

from canopen_device.visible_text import visible_lines


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
