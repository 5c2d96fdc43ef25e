"""Bring the figures of a finished report into docs/report.md.

python -m bench.report_document build/report docs    (after `make report`)
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from tipforce_lab.report.study import Counted
from tipforce_lab.report.text import shown_counts, shown_error, shown_time

BEGIN, END = "<!-- begin: written by bench.report_document -->\n", "<!-- end -->\n"


def section(records: list[dict[str, Any]]) -> str:
    """Markdown of what report.jsonl says: of each method the most exact setting."""
    head, *rest = records
    machine = ", ".join(f"{name} {value}" for name, value in head["machine"].items())
    effort = "quick" if head["quick"] else "full"
    lines = [f"Measured by a {effort} run of {head['date']}, seed {head['seed']}: {machine}.", ""]
    lines += _first(head)
    for one in rest:
        if one["record"] == "study":
            lines += _study(one)
        elif one["record"] == "grid":
            lines += _grid(one)
    cases = [one for one in rest if one["record"] == "case"]
    if cases:
        lines += ["## Extreme cases", "", "| case | outcome | situation | claim | seen |", "|---|---|---|---|---|"]
        lines += [_row(f"`{c['key']}`", _outcome(c), c["situation"], c["claim"], c["figures"]) for c in cases]
        lines.append("")
    for one in rest:
        if one["record"] == "left out":
            lines += [f"Left out: {one['key']}: {one['reason']}", ""]
    return "\n".join(lines)


def _first(head: dict[str, Any]) -> list[str]:
    """The verdict and the recommendations, which the first record has."""
    lines = ["## Verdict", "", *(f"- {sentence}" for sentence in head["verdict"]), ""]
    if head["advice"]:
        lines += [
            "## Which method for which need",
            "",
            "| need | method | error | processor time |",
            "|---|---|---|---|",
        ]
        lines += [_row(*one) for one in head["advice"]]
        lines.append("")
    return lines


def _grid(grid: dict[str, Any]) -> list[str]:
    lines = [f"## {grid['title']}", "", *(f"- {remark}" for remark in grid["remarks"])]
    lines += [f"- {reason}" for reason in _reasons(grid)]
    lines += ["", _row(grid["corner"], *grid["methods"]), "|---" * (1 + len(grid["methods"])) + "|"]
    for row in grid["rows"]:
        cells = [shown_counts(Counted(**cell)) for cell in row["cells"]]
        cells = [f"**{cell}**" if over else cell for cell, over in zip(cells, row["over"], strict=True)]
        lines.append(_row(row["name"], *cells))
    return [*lines, ""]


def _reasons(grid: dict[str, Any]) -> list[str]:
    found: dict[str, list[str]] = {}
    for row in grid["rows"]:
        for reason in dict.fromkeys(filter(None, row["reasons"])):
            found.setdefault(reason, []).append(row["name"])
    return [f"{'; '.join(names)}: {reason}" for reason, names in found.items()]


def _study(study: dict[str, Any]) -> list[str]:
    key = study["key"]
    lines = [f"## {study['title']}", "", f"![{study['title']}: error against time](figures/report-{key}.svg)", ""]
    lines += [f"- {remark}" for remark in study["remarks"]]
    lines += [f"- Left out: {method}: {reason}" for method, reason in study["left_out"].items()]
    time = study["work_unit"].replace("s per", "time per")
    lines += [
        "",
        f"| method | most exact setting | {study['error_unit']} | {time} | quartiles | processor |",
        "|---|---|---|---|---|---|",
    ]
    for one in study["series"]:
        # JSON has no infinity: null stands for it, and for NaN.
        point = min(one["points"], key=_error_then_time)
        timing = point["timing"]
        quartiles = " - ".join(shown_time(timing[name]) for name in ("first_quartile_s", "third_quartile_s"))
        error = "not finite" if point["error"] is None else shown_error(point["error"])
        cpu = "" if timing["cpu_seconds"] is None else shown_time(timing["cpu_seconds"])
        lines.append(_row(one["method"], point["setting"], error, shown_time(timing["seconds"]), quartiles, cpu))
    own = f"its own error is {shown_error(study['reference_error'])}" if study["reference_error"] else "it is exact"
    if study["check_difference"] is not None:
        own += f". Checked independently ({study['check']}): differs by {shown_error(study['check_difference'])}"
    return [*lines, "", f"Reference: {study['reference']}; {own}.", ""]


def _error_then_time(point: dict[str, Any]) -> tuple[float, float]:
    error = float("inf") if point["error"] is None else point["error"]
    return error, point["timing"]["seconds"]


def _outcome(case: dict[str, Any]) -> str:
    return str(case["outcome"]) if case["held"] else f"**NOT {case['outcome']}**"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def replaced(document: str, section_text: str) -> str:
    """The document with another text between its two marks. Raises ValueError where it has not got them."""
    before, rest = document.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}{section_text}{END}{after}"


def main() -> None:
    """Arguments: the folder of a report, the folder of the documents."""
    report, docs = map(Path, sys.argv[1:])
    lines = (report / "report.jsonl").read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    path = docs / "report.md"
    path.write_text(replaced(path.read_text(encoding="utf-8"), section(records)), encoding="utf-8")
    for one in records:
        if one["record"] == "study":
            shutil.copyfile(report / f"{one['key']}.svg", docs / "figures" / f"report-{one['key']}.svg")


if __name__ == "__main__":
    main()
