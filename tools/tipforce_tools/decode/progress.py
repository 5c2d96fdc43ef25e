"""A progress bar on the terminal, in bytes of the logs."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from tipforce.host.decoding.log_part import Piece
from tipforce_tools.cli.output import terminal

_WIDTH = 30
_EVERY_S = 0.1


class ProgressBar:
    """Shown on stderr if that is a terminal and the sizes of the logs are known."""

    def __init__(self, names: Sequence[str], args: Namespace) -> None:
        self._total = sum(Path(name).stat().st_size for name in names if Path(name).is_file())
        self._wanted = (
            sys.stderr.isatty() and not args.quiet and not args.follow and self._total > 0
            and not (sys.stdout.isatty() and args.output is None and not args.summary)
        )  # fmt: skip
        self._before = self._here = 0
        self._next = 0.0
        self._shown = False

    @property
    def wanted(self) -> bool:
        """Whether the bar is shown."""
        return self._wanted

    def __call__(self, position: int) -> None:
        """Set the position in the current log, in bytes; a smaller one than before means the next log."""
        if position < self._here:
            self._before += self._here
        self._here = position
        now = time.monotonic()
        if self._wanted and now >= self._next:
            self._next = now + _EVERY_S
            share = min((self._before + position) / self._total, 1.0)
            bar = "#" * round(share * _WIDTH)
            done, total = (self._before + position) / 1e6, self._total / 1e6
            print(f"\r[{bar:{_WIDTH}}] {done:.1f} of {total:.1f} MB", end="", file=terminal(sys.stderr), flush=True)
            self._shown = True

    def add(self, piece: Piece) -> None:
        """Count a whole piece."""
        end = Path(piece.name).stat().st_size if piece.end is None else piece.end
        self(self._here + end - piece.start)

    def close(self) -> None:
        """Clear the bar."""
        if self._shown:
            print("\r\x1b[K", end="", file=terminal(sys.stderr), flush=True)
