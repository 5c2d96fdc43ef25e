"""How a command prints, and its standard streams: each text passes here, what could control a terminal is escaped.

Data in bytes (CSV, Parquet) goes to ``sys.stdout.buffer`` as it is. The colours of tables go to the stream below.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, TextIO, cast

from canopen_device.visible_text import visible_lines

if TYPE_CHECKING:
    import argparse


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


class Output:
    """How a command prints: the values of its output flags. One for the process, as its streams are."""

    json = quiet = verbose = False
    color: Literal["auto", "always", "never"] = "auto"

    def set_up(self, args: argparse.Namespace) -> None:
        """Follow the flags; a command without them prints as by default, and sets up no logging. Warnings of tipforce
        are logged to stderr: all messages with -v, only errors with -q; of libraries only with -v."""
        for name in ("json", "quiet", "verbose", "color"):
            setattr(self, name, getattr(args, name, getattr(Output, name)))
        if not hasattr(args, "verbose"):
            return
        import logging

        level = logging.ERROR if self.quiet else logging.DEBUG if self.verbose else logging.WARNING
        logging.basicConfig(stream=sys.stderr, level=level, format="%(levelname)s %(name)s: %(message)s")
        if not self.verbose:
            # canopen logs each abort as an error and also raises it; python-can warns of errors that open_bus reports.
            logging.getLogger("canopen").setLevel(logging.CRITICAL)
            logging.getLogger("can").setLevel(logging.CRITICAL)


OUTPUT = Output()
