"""Every conformance case against a running node, by the command line: half of them on vcan0, half on vcan1.

Most of the time a case waits for what must not come. So there are two nodes, each on a bus of its own, at once."""

import json
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from conformance.fingertip import all_cases
from vcan.support import Launch, running_node

TOLERANCE_MS = "50"  # a machine that does other work as well; the command itself takes 20
WHOLE_RUN_S = 600.0  # it takes about 20 s in User-mode Linux
AGAIN = 3  # a loaded machine delays a frame of one case or another; a fault fails each time
HALVES = {"vcan0": "[a-m]*.*", "vcan1": "[n-z]*.*"}  # names of cases; a clause has capitals, or no point


def records_of(launch: Launch, runs: dict[str, str]) -> dict[str, dict[str, Any]]:
    """Run the cases of each pattern on its bus; return the records by case."""
    always = ("--node-id", "5", "--persistent", "--json", "--tolerance", TOLERANCE_MS, "-i", "socketcan")
    commands = [launch("conformance", *always, "-c", channel, "--case", pattern) for channel, pattern in runs.items()]
    for command in commands:
        assert command.wait(WHOLE_RUN_S) in (0, 1), command.stderr
    return {record["case"]: record for command in commands for record in map(json.loads, command.stdout.splitlines())}


def test_every_case_passes_on_a_real_bus(launch: Launch, tmp_path: Path) -> None:
    with ExitStack() as stack:
        for channel in HALVES:
            flags = ("--store", str(tmp_path / f"{channel}.json"), "--noise", "0", "--uncalibrated")
            stack.enter_context(running_node(tmp_path, *flags, channel=channel))
        records = records_of(launch, HALVES)
        for _ in range(AGAIN):
            for case in [case for case, record in records.items() if record["verdict"] == "FAIL"]:
                records |= records_of(launch, {"vcan0": case})
    failed = [
        "\n".join([r["case"], r["title"], r["reason"], *r["log"]]) for r in records.values() if r["verdict"] == "FAIL"
    ]
    assert not failed, "\n\n".join(failed)
    verdicts = Counter(record["verdict"] for record in records.values())
    assert verdicts["not applicable"] == sum(case.error_frames for case in all_cases())
    assert sorted(records) == sorted(case.name for case in all_cases())
