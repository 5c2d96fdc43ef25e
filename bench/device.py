"""Measure the device core: cost per request and SYNC, memory, latency beside other loops, CPU share of a hand.

    python -m bench.device                 everything, about a minute and a half
    python -m bench.device costs           inside one process
    python -m bench.device latency cpu     over loopback sockets

docs/device-performance.md holds the figures and what they mean.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

from bench import device_costs, device_latency


def machine() -> str:
    """Processor, cores, versions, load at the start: what the figures depend on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        model = names[0] if names else model
    versions = f"Python {platform.python_version()}, python-can {version('python-can')}, canopen {version('canopen')}"
    return f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {platform.system()}; {versions}"


def main() -> int:
    """Run as a command."""
    parser = argparse.ArgumentParser(description="Measure the CANopen device core.")
    parser.add_argument("parts", nargs="*", metavar="costs|latency|cpu", help="default: all")
    parser.add_argument("--syncs", type=int, default=1500, help="per loop and number of nodes")
    options = parser.parse_args()
    parts = options.parts or ["costs", "latency", "cpu"]
    print(machine(), flush=True)
    if "costs" in parts:
        print("\n".join(device_costs.report_costs()), flush=True)
    if "latency" in parts:
        for nodes in (1, 5, 15):
            print("\n".join(device_latency.report_latency(nodes, options.syncs)), flush=True)
    if "cpu" in parts:
        print("\n".join(device_latency.report_cpu()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
