"""How long a start takes: a node up to its boot-up frame, `tipforce --help`, and what the node's imports cost.

    python bench/startup.py                            without a bus
    tipforce vcan -- python bench/startup.py           the boot-up frame on vcan0, too

Each figure comes from processes of their own, one after the other; the smallest of many runs says what the code
costs, the spread says how busy the machine was. Times are in milliseconds.
"""

from __future__ import annotations

import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

from bench.measure import TIPFORCE, arguments, command_s, in_turns, machine, table

from canopen_device.can_frame import CAN_FRAME

NODE_ID = 5
BOOT_UP = 0x700 + NODE_ID
GIVE_UP_S = 30.0
SHOWN_IMPORTS = 8
INTERFACE, RUNS = "vcan0", 20

# The whole command, as it is; only the socket is replaced, by a port that tells when the boot-up frame reaches it.
NO_BUS_CODE = f"""
import os, sys, time
import tipforce_tools.cli.main, tipforce_tools.cli.service
class Port:
    def send(self, frames):
        if {BOOT_UP} in [can_id for can_id, _ in frames]:
            print(time.monotonic_ns(), flush=True)
            os._exit(0)
tipforce_tools.cli.service.open_port = lambda _args: (Port(), "no bus")
sys.exit(tipforce_tools.cli.main.main(["node", "--node-id", "{NODE_ID}", "-q"]))
"""


def whole_run_ms(*words: str) -> float:
    """From the start of `python WORDS` to its end."""
    return 1e3 * command_s([sys.executable, *words], stdout=subprocess.DEVNULL)[1]


def boot_up_without_bus_ms() -> float:
    """From the start of `tipforce node` to its boot-up frame at the door to the bus."""
    start_ns, command = time.monotonic_ns(), [sys.executable, "-c", NO_BUS_CODE]
    return (int(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout) - start_ns) * 1e-6


def boot_up_on_bus_ms() -> float:
    """From the start of `tipforce node` to its boot-up frame on vcan0."""
    words = [*TIPFORCE, "node", "--node-id", str(NODE_ID), "-i", "socketcan", "-c", INTERFACE, "-q"]
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind((INTERFACE,))
        bus.settimeout(GIVE_UP_S)
        start_ns = time.monotonic_ns()
        with subprocess.Popen(words) as process:
            try:
                while CAN_FRAME.unpack(bus.recv(CAN_FRAME.size))[0] != BOOT_UP:
                    pass
                return (time.monotonic_ns() - start_ns) * 1e-6
            finally:
                process.terminate()


def imports_ms(*words: str) -> list[tuple[str, float]]:
    """What the packages cost that ``python WORDS`` imports, without those that they import in turn; largest first."""
    run = [sys.executable, "-X", "importtime", *words]
    lines = subprocess.run(run, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True).stderr
    costs: dict[str, float] = {}
    for line in lines.splitlines():
        cost_us, _, name = line.removeprefix("import time:").split("|")
        if cost_us.strip().isdigit():
            package = name.strip().partition(".")[0]
            costs[package] = costs.get(package, 0.0) + int(cost_us) / 1000
    return sorted(costs.items(), key=lambda item: -item[1])[:SHOWN_IMPORTS]


def has_interface() -> bool:
    """True where frames can be sent on vcan0."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.bind((INTERFACE,))
    except (AttributeError, OSError):  # no SocketCAN in this Python, or no such interface
        return False
    return True


def measure(runs: int) -> dict[str, list[float]]:
    """Each figure's runs in milliseconds. The figures take turns, so that a busy spell does not hit one alone."""
    figures: dict[str, Callable[[], float]] = {
        "python -c pass": lambda: whole_run_ms("-c", "pass"),
        "tipforce --help": lambda: whole_run_ms("-m", "tipforce_tools.cli.main", "--help"),
        "tipforce node to boot-up, no bus": boot_up_without_bus_ms,
    }
    if has_interface():
        figures[f"tipforce node to boot-up on {INTERFACE}"] = boot_up_on_bus_ms
    in_turns(figures, 1)  # compiles what has no bytecode yet, and fills the disk's cache
    return in_turns(figures, runs)


def main() -> None:
    arguments(__doc__).parse_args()
    on, runs = machine("tipforce", "python-can", "numpy", "msgspec"), measure(RUNS)
    rows = [[name, *(f"{pick(ms):.1f}" for pick in (min, statistics.median, max))] for name, ms in runs.items()]
    print(f"{on}\n\n{table([f'{RUNS} runs, milliseconds', 'min', 'median', 'max'], rows, markdown=False)}")
    print("imports of `tipforce node`, once, with the cost of measuring:")
    for name, cost_ms in imports_ms("-c", NO_BUS_CODE):
        print(f"  {name:44}{cost_ms:8.1f}")


if __name__ == "__main__":
    main()
