"""How long a start takes: a node up to its boot-up frame, `tipforce --help`, and what the node's imports cost.

    python bench/startup.py                            without a bus
    tipforce vcan -- python bench/startup.py           the boot-up frame on vcan0, too

Each figure comes from processes of their own, one after the other; the smallest of many runs says what the code
costs, the spread says how busy the machine was. Times are in milliseconds.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from tipforce.socketcan import CAN_FRAME

NODE_ID = 5
BOOT_UP = 0x700 + NODE_ID
GIVE_UP_S = 30.0
SHOWN_IMPORTS = 8

# The whole command, as it is; only the socket is replaced, by a port that tells when the boot-up frame reaches it.
NO_BUS_CODE = f"""
import os, sys, time
import tipforce_tools.cli.main, tipforce_tools.cli.port
class Port:
    def send(self, frames):
        if {BOOT_UP} in [can_id for can_id, _ in frames]:
            print(time.monotonic_ns(), flush=True)
            os._exit(0)
tipforce_tools.cli.port.open_port = lambda _args: (Port(), "no bus")
sys.exit(tipforce_tools.cli.main.main(["node", "--node-id", "{NODE_ID}", "-q"]))
"""


def run_python(*words: str) -> str:
    """stdout of a Python process of its own. Raises CalledProcessError when it fails."""
    return subprocess.run([sys.executable, *words], check=True, stdout=subprocess.PIPE, text=True).stdout


def whole_run_ms(*words: str) -> float:
    """From the start of `python WORDS` to its end."""
    start_ns = time.monotonic_ns()
    run_python(*words)
    return (time.monotonic_ns() - start_ns) * 1e-6


def boot_up_without_bus_ms() -> float:
    """From the start of `tipforce node` to its boot-up frame at the door to the bus."""
    start_ns = time.monotonic_ns()
    return (int(run_python("-c", NO_BUS_CODE)) - start_ns) * 1e-6


def boot_up_on_bus_ms(interface: str) -> float:
    """From the start of `tipforce node` to its boot-up frame on a SocketCAN interface."""
    words = [
        "-m",
        "tipforce_tools.cli.main",
        "node",
        "--node-id",
        str(NODE_ID),
        "-i",
        "socketcan",
        "-c",
        interface,
        "-q",
    ]
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind((interface,))
        bus.settimeout(GIVE_UP_S)
        start_ns = time.monotonic_ns()
        with subprocess.Popen([sys.executable, *words]) as process:
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
    found: dict[str, float] = {}
    for line in lines.splitlines():
        cost_us, _, name = line.removeprefix("import time:").split("|")
        if cost_us.strip().isdigit():
            package = name.strip().partition(".")[0]
            found[package] = found.get(package, 0.0) + int(cost_us) / 1000
    return sorted(found.items(), key=lambda item: -item[1])[:SHOWN_IMPORTS]


def has_interface(name: str) -> bool:
    """True where frames can be sent on a SocketCAN interface."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
            bus.bind((name,))
    except (AttributeError, OSError):  # no SocketCAN in this Python, or no such interface
        return False
    return True


def measure(runs: int, interface: str) -> dict[str, list[float]]:
    """Each figure's runs in milliseconds. The figures take turns, so that a busy spell does not hit one alone."""
    figures: dict[str, Callable[[], float]] = {
        "python -c pass": lambda: whole_run_ms("-c", "pass"),
        "tipforce --help": lambda: whole_run_ms("-m", "tipforce_tools.cli.main", "--help"),
        "tipforce node to boot-up, no bus": boot_up_without_bus_ms,
    }
    if has_interface(interface):
        figures[f"tipforce node to boot-up on {interface}"] = lambda: boot_up_on_bus_ms(interface)
    for figure in figures.values():
        figure()  # compiles what has no bytecode yet, and fills the disk's cache
    found: dict[str, list[float]] = {name: [] for name in figures}
    for _ in range(runs):
        for name, figure in figures.items():
            found[name].append(figure())
    return found


def machine() -> dict[str, str]:
    """What the figures were measured on."""
    return {
        "processor": processor(),
        "processors": str(os.cpu_count()),
        "kernel": f"{platform.system()} {platform.release()}",
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        **{name: version(name) for name in ("tipforce", "python-can", "numpy", "msgspec")},
    }


def processor() -> str:
    """The processor's name, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--runs", type=int, default=20, metavar="N", help="of each figure (default %(default)s)")
    parser.add_argument("--interface", default="vcan0", help="SocketCAN interface, if there is one (%(default)s)")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    args = parser.parse_args()
    if args.runs < 1:
        parser.error(f"-n {args.runs}: allowed is 1 or more")
    found = measure(args.runs, args.interface)
    if args.json:
        print(json.dumps({"machine": machine(), "unit": "ms", "runs": found, "imports": imports_ms("-c", NO_BUS_CODE)}))
        return 0
    print(", ".join(f"{name} {value}" for name, value in machine().items()))
    print(f"\n{args.runs} runs, milliseconds{'':26}{'min':>8}{'median':>8}{'max':>8}")
    for name, values in found.items():
        print(f"{name:46}{min(values):8.1f}{statistics.median(values):8.1f}{max(values):8.1f}")
    print("imports of `tipforce node`, once, with the cost of measuring:")
    for name, cost_ms in imports_ms("-c", NO_BUS_CODE):
        print(f"  {name:44}{cost_ms:8.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
