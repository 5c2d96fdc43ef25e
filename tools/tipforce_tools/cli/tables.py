"""Tables for people, by rich; loaded where one is printed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from itertools import repeat
from typing import TYPE_CHECKING, Any, Literal

from canopen_device.visible_text import visible_lines
from tipforce_tools.cli.output import OUTPUT, terminal

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def console(*, stderr: bool = False) -> Console:
    """Return a rich console that follows --color and NO_COLOR; tables written to a pipe have a fixed width. It is on
    the stream below VisibleStream: its colours pass, every text is escaped, and none is markup."""
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

    plain = OUTPUT.color == "never" or (OUTPUT.color == "auto" and bool(os.environ.get("NO_COLOR")))
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else 120
    always = True if OUTPUT.color == "always" else None
    # Without a colour system rich prints no bold text either: the output is plain text.
    system: Literal["auto"] | None = None if plain else "auto"
    return VisibleConsole(
        file=terminal(stream), force_terminal=always, color_system=system, no_color=plain, width=width
    )


def print_table(table: Table) -> None:
    """Print a table on stdout. In a narrow terminal it has no borders; words wrap, and numbers do not: a wrapped one
    would appear beside the label of another. A word longer than its column continues on the next line."""
    screen = console()
    unbounded = screen.options.update(width=1000)
    if screen.measure(table, options=unbounded).maximum > screen.width:
        table.box, table.padding, table.pad_edge = None, (0, 1, 0, 0), False
        for column in table.columns:
            column.overflow = "fold"
            if column.justify == "right":
                column.no_wrap, column.header = True, str(column.header).replace(" ", "\n")
        # The terminal wraps a table that is still too wide.
        screen.width = max(screen.width, screen.measure(table, options=unbounded).minimum)
    screen.print(table)


def print_rows(
    title: str, headings: Iterable[str], rows: Iterable[Iterable[str]], styles: Iterable[str | None] | None = None, *,
    lines: bool = False,
) -> None:  # fmt: skip
    """Print a table on stdout, with ``lines`` between rows; > in front of a heading puts its column at the right."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_lines=lines)
    for heading in headings:
        table.add_column(heading.removeprefix(">"), justify="right" if heading.startswith(">") else "left")
    for row, style in zip(rows, repeat(None) if styles is None else styles, strict=False):
        table.add_row(*row, style=style)
    print_table(table)
