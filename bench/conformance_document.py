"""docs/conformance.md: every case with its result in process and on vcan. Run: see ``COMMAND``.

Where vcan0 is up, a node is started on it and the cases run against that process too.
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

from canopen_conformance.case import all_cases
from canopen_conformance.links import CORE_NODE_ID
from canopen_conformance.report import by_clause
from canopen_conformance.run import run_in_process

COMMAND = "tipforce vcan -- python -m bench.conformance_document > docs/conformance.md"
INTERFACE = "vcan0"
_START_S = 20
_HEAD = f"""\
# Conformance

`tipforce conformance --node-id N` checks any CANopen device on a bus with raw frames, case by case, and prints a
report by clause; `--list` shows the cases, `--case PATTERN` chooses, `--persistent` allows those that store parameters
or change the node-id. What the device does not have is "not applicable", never passed.

The same cases run in the tests against the device core in this process, with a fake clock (time passes only where a
case waits, so measured times are exact), and against `tipforce node` on a real vcan, where measured times may be off by
20 ms (`--tolerance`). A frame that must come is waited for 200 ms (an SDO answer 1 s, a boot-up 5 s), one that must not
come 30 ms.

The table is generated: `{COMMAND}`

| clause | case | what is checked | in process | vcan |
|---|---|---|---|---|
"""


def table(vcan: dict[str, str]) -> str:
    """The document; ``vcan`` has the result of each case that ran there."""
    rows = []
    for case in by_clause(all_cases()):
        result, _link = run_in_process(case)
        title = case.title.replace("|", "\\|")
        rows.append(
            f"| {case.clause} | {case.name} | {title} | {result.verdict} | {vcan.get(case.name, 'not run')} |\n"
        )
    return _HEAD + "".join(rows)


def command_line(*words: str) -> list[str]:
    """The command `tipforce` of this installation."""
    return [sys.executable, "-m", "tipforce_tools.cli.main", *words, "-i", "socketcan", "-c", INTERFACE]


@contextmanager
def running_node(store: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`tipforce node` on vcan0, which has booted."""
    import can

    with can.Bus(interface="socketcan", channel=INTERFACE) as bus:
        words = command_line("node", "--node-id", str(CORE_NODE_ID), "--store", str(store), "--noise", "0", "-q")
        process = subprocess.Popen(words)
        try:
            deadline = time.monotonic() + _START_S
            while (message := bus.recv(1.0)) is None or message.arbitration_id != 0x700 + CORE_NODE_ID:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError("the node did not boot")
            yield process
        finally:
            process.terminate()
            process.wait(10)


def run_on_vcan(folder: Path) -> list[dict[str, str]]:
    """Every case by the command line against a running node: its JSON records."""
    with running_node(folder / "store.json"):
        words = command_line("conformance", "--node-id", str(CORE_NODE_ID), "--persistent", "--json", "-q")
        done = subprocess.run(words, stdout=subprocess.PIPE, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"tipforce conformance ended with {done.returncode}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def _writable_folder() -> str | None:
    """A root that is read-only (User-mode Linux) still has memory."""
    return "/dev/shm" if os.path.isdir("/dev/shm") else None


def main() -> int:
    """Print the document."""
    found: dict[str, str] = {}
    if os.path.exists(f"/sys/class/net/{INTERFACE}"):
        with tempfile.TemporaryDirectory(dir=_writable_folder()) as folder:
            found = {record["case"]: record["verdict"] for record in run_on_vcan(Path(folder))}
    print(table(found), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
