"""Every conformance case against a running node, by the command line: half of them on vcan0, half on vcan1.

Most of the time a case waits for what must not come. So there are two nodes, each on a bus of its own, at once.
"""

import json
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

from tipforce_tools.conformance.case import all_cases
from vcan.support import Launch, running_node

TOLERANCE_MS = "50"  # a machine that does other work as well; the command itself takes 20
WHOLE_RUN_S = 180.0  # it takes about 20 s in User-mode Linux
HALVES = {"vcan0": "[a-m]*.*", "vcan1": "[n-z]*.*"}  # names of cases; a clause has capitals, or no point


def test_every_case_passes_on_a_real_bus(launch: Launch, tmp_path: Path) -> None:
    with ExitStack() as stack:
        for channel in HALVES:
            flags = ("--store", str(tmp_path / f"{channel}.json"), "--noise", "0")
            stack.enter_context(running_node(tmp_path, *flags, channel=channel))
        always = ("--node-id", "5", "--persistent", "--json", "--tolerance", TOLERANCE_MS, "-i", "socketcan")
        commands = [launch("conformance", *always, "-c", channel, "--case", HALVES[channel]) for channel in HALVES]
        codes = [command.wait(WHOLE_RUN_S) for command in commands]
    records = [json.loads(line) for command in commands for line in command.stdout.splitlines()]
    failed = ["\n".join([r["case"], r["title"], r["reason"], *r["log"]]) for r in records if r["verdict"] == "FAIL"]
    assert not failed, "\n\n".join(failed)
    assert codes == [0, 0], "\n".join(command.stderr for command in commands)
    verdicts = Counter(record["verdict"] for record in records)
    assert verdicts["not applicable"] == sum(case.error_frames for case in all_cases())
    assert sorted(record["case"] for record in records) == sorted(case.name for case in all_cases())
