"""The results of every conformance case against a node on vcan0: a list by case, and docs/conformance.md, its summary.

Run: see ``LIST_COMMAND``, then ``COMMAND``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.measure import TIPFORCE, arguments

from canopen_conformance.case import all_cases
from tipforce_tools import fingertip_cases

LIST_COMMAND = "tipforce vcan -- python -m bench.conformance_document > build/conformance.md"
COMMAND = "python -m bench.conformance_document --summary build/conformance.md > docs/conformance.md"
INTERFACE, NODE_ID = "vcan0", 5
_START_S = 20
GROUPS = {
    "CiA 301 7.2.2": "PDO", "CiA 301 7.2.4": "SDO", "CiA 301 7.2.5": "SYNC", "CiA 301 7.2.6": "TIME",
    "CiA 301 7.2.7": "EMCY", "CiA 301 7.2.8": "NMT, heartbeat, node guarding", "CiA 301 7.3.2": "services by NMT state",
    "CiA 301 7.3.3": "pre-defined connection set", "CiA 301 7.3.5": "restricted CAN-IDs",
    "CiA 301 7.4": "data types and dummy entries", "CiA 301 7.5.2": "objects 1000h to 1FFFh",
    "CiA 302-2": "NMT start-up",
    "CiA 305 6": "LSS", "CiA 404": "analogue inputs of the fingertip", "tipforce": "the fingertip's own objects",
}  # fmt: skip
"""The beginnings of clauses, and what they are about."""
_HEAD = """\
# Conformance

`tipforce conformance --node-id N` checks a CANopen device on a bus with raw frames, case by case, and prints a report
by clause. `python -m canopen_conformance`, which needs python-can and the standard library alone, does the same without
the cases of a fingertip; the folder `tools/canopen_conformance` works when it is copied to another project.

A required frame is awaited for 200 ms (an SDO response 1 s, a boot-up 5 s), a forbidden one for 30 ms; `--tolerance` is
the permitted error of measured times. A case is "not applicable", never passed, if an object that it needs does not
exist or the device may refuse its precondition, if it is a fingertip's and the product code (1018h:2) is another one,
if it stores parameters and `--persistent` is not given, or if it needs error frames of the CAN controller.

The tests run every case against the device core in one process, with a simulated clock, and on a real vcan. Results of
`tipforce node` on a vcan, by clause:

| clauses | about | cases | passed | not applicable |
|---|---|---|---|---|
"""
_END = f"""
`{LIST_COMMAND}` lists them by case;
`{COMMAND}` writes this page.
"""


def group_of(clause: str) -> str:
    """The beginning of the clause that the summary counts it by."""
    return next(start for start in GROUPS if clause.startswith(start))


def listing(records: list[dict[str, str]]) -> str:
    """A table of the results by case."""
    rows = [[r["clause"], r["case"], r["title"].replace("|", "\\|"), r["verdict"]] for r in records]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def summary(rows: list[tuple[str, str]]) -> str:
    """The page; ``rows`` are the clause and the verdict of each case. Raises ValueError if a case failed."""
    if {verdict for _clause, verdict in rows} - {"pass", "not applicable"}:
        raise ValueError("a case failed")
    text = _HEAD
    for start, about in GROUPS.items():
        verdicts = [verdict for clause, verdict in rows if group_of(clause) == start]
        text += f"| {start} | {about} | {len(verdicts)} | {verdicts.count('pass')} | "
        text += f"{verdicts.count('not applicable')} |\n"
    return text + _END


def command_line(*words: str) -> list[str]:
    """The command `tipforce` of this installation, on vcan0."""
    return [*TIPFORCE, *words, "-i", "socketcan", "-c", INTERFACE]


@contextmanager
def running_node(store: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`tipforce node` on vcan0, which has booted."""
    import can

    with can.Bus(interface="socketcan", channel=INTERFACE) as bus:
        words = command_line("node", "--node-id", str(NODE_ID), "--store", str(store), "--noise", "0", "-q")
        process = subprocess.Popen(words)
        try:
            deadline = time.monotonic() + _START_S
            while (message := bus.recv(1.0)) is None or message.arbitration_id != 0x700 + NODE_ID:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError("the node did not boot")
            yield process
        finally:
            process.terminate()
            process.wait(10)


def run_on_vcan(folder: Path) -> list[dict[str, str]]:
    """Every case by the command line against a running node: its JSON records."""
    with running_node(folder / "store.json"):
        words = command_line("conformance", "--node-id", str(NODE_ID), "--persistent", "--json", "-q")
        done = subprocess.run(words, stdout=subprocess.PIPE, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"tipforce conformance ended with {done.returncode}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def main() -> int:
    parser = arguments(__doc__)
    parser.add_argument("--summary", type=Path, metavar="LIST", help="of this list")
    path = parser.parse_args().summary
    if path:
        cells = [line.strip("| \n").split(" | ") for line in path.read_text(encoding="utf-8").splitlines()]
        print(summary([(row[0], row[-1]) for row in cells]), end="")
        return 0
    # A root that is read-only (User-mode Linux) still has memory.
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        records = run_on_vcan(Path(folder))
    if len(records) != len(all_cases(fingertip_cases)):
        raise RuntimeError(f"{len(records)} results")
    print(listing(records), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
