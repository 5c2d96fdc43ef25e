"""Bring verdict and recommendations of a finished report into docs/report.md.

python -m bench.report_document    (after `make report`, which writes build/report)
"""

from __future__ import annotations

import json
from typing import Any

from bench.measure import ROOT, table

BEGIN, END = "<!-- begin: written by bench.report_document -->\n", "<!-- end -->\n"


def section(head: dict[str, Any]) -> str:
    """Markdown of the first record of report.jsonl."""
    machine = ", ".join(f"{name} {value}" for name, value in head["machine"].items())
    effort = "quick" if head["quick"] else "full"
    parts = [f"A {effort} run of {head['date']}, seed {head['seed']}: {machine}."]
    parts.append("\n".join(f"- {sentence}" for sentence in head["verdict"]))
    if head["advice"]:
        parts.append(table(["need", "method", "error", "processor time"], head["advice"]))
    return "\n\n".join(parts) + "\n"


def replaced(document: str, text: str) -> str:
    """The document with another text between its two marks. Raises ValueError where it has not got them."""
    before, rest = document.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}{text}{END}{after}"


def main() -> None:
    head = json.loads((ROOT / "build" / "report" / "report.jsonl").read_text(encoding="utf-8").splitlines()[0])
    path = ROOT / "docs" / "report.md"
    path.write_text(replaced(path.read_text(encoding="utf-8"), section(head)), encoding="utf-8")


if __name__ == "__main__":
    main()
