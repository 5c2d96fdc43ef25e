"""Every conformance case against a running node on vcan0, by the command line."""

import json
from collections import Counter
from pathlib import Path

from tipforce_tools.conformance.case import all_cases
from vcan.support import BUS, Launch, running_node

TOLERANCE_MS = "50"  # a machine that does other work as well; the command itself takes 20
WHOLE_RUN_S = 180.0  # it takes about 50 s in User-mode Linux


def test_every_case_passes_on_a_real_bus(launch: Launch, tmp_path: Path) -> None:
    with running_node(tmp_path, "--store", str(tmp_path / "store.json"), "--noise", "0"):
        command = launch("conformance", "--node-id", "5", *BUS, "--persistent", "--json", "--tolerance", TOLERANCE_MS)
        code = command.wait(WHOLE_RUN_S)
    records = [json.loads(line) for line in command.stdout.splitlines()]
    failed = ["\n".join([r["case"], r["title"], r["reason"], *r["log"]]) for r in records if r["verdict"] == "FAIL"]
    assert not failed, "\n\n".join(failed)
    assert code == 0, command.stderr
    verdicts = Counter(record["verdict"] for record in records)
    assert verdicts["not applicable"] == sum(case.error_frames for case in all_cases())
    assert verdicts.total() == len(all_cases())
