"""How benchmarks print what they found."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def table(header: list[str], rows: list[list[str]], markdown: bool) -> str:
    """A table as aligned text or as Markdown."""
    if markdown:
        lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
        return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    return "\n".join(
        "  ".join(f"{text:>{width}}" for text, width in zip(row, widths, strict=True)) for row in [header, *rows]
    )


def main(
    description: str | None, measure: Callable[[], dict[str, Any]], as_table: Callable[[dict[str, Any]], str]
) -> None:
    """Parse, measure with the runners of the tests, print as a table or, with --json, as it is."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="JSON instead of a table")
    args = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the runner lives with the tests that use it too
    found = measure()
    print(json.dumps(found, indent=1) if args.json else as_table(found))
