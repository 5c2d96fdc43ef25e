"""Write the record of all extreme cases, which `tipforce report` shows (`make report`)."""

import importlib
import json
from pathlib import Path

from stability.case import Case, Observed, cases_of, plain

AREAS = (
    "contact", "uncertainty", "layout", "gauges", "filters", "calibration", "fit", "wire", "clock", "dynamics",
    "impact",
)  # fmt: skip
"""Modules of this folder, in the order of the report."""
RECORD = Path(__file__).parents[2] / "tools" / "tipforce_lab" / "report" / "cases.jsonl"


def cases() -> list[Case]:
    """Return all cases by area."""
    return [case for area in AREAS for case in cases_of(importlib.import_module(f"stability.{area}"))]


def recorded(case: Case, observed: Observed) -> dict[str, object]:
    """Return the record of one case, as ``tipforce_lab.report.study.Case`` reads it."""
    return {
        "key": case.key,
        "situation": case.situation,
        "outcome": case.outcome,
        "claim": case.claim,
        "held": bool(observed.held),  # numpy's bool is not a bool of JSON
        "figures": plain(observed.figures),
    }


if __name__ == "__main__":
    RECORD.write_text("".join(json.dumps(recorded(case, case.check())) + "\n" for case in cases()), encoding="utf-8")
