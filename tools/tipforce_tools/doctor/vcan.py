"""Checks of buses without hardware: `tipforce vcan`, by running a command in it, and UDP multicast."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

from tipforce.errors import TipforceError
from tipforce_tools.doctor.check import Check

INTERFACES = ("vcan0", "vcan1")
_PLACES = {
    "direct": "they are up on this kernel",
    "namespace": "this kernel creates them for each run",
    "uml": "in User-mode Linux, which boots here",
}


_UDP = "-i udp_multicast -c 239.74.163.2 is a bus of UDP datagrams"


def trial() -> int:
    """Run `true` with the buses; return its exit code. Raises EnvironmentLackError."""
    from tipforce_tools.vcan.run import run_with_vcan

    return run_with_vcan(["true"], interfaces=INTERFACES, timeout_s=120.0)


def vcan_checks(try_it: Callable[[], int] | None = None) -> Iterator[Check]:
    """Yield one check; ``try_it`` replaces the trial in tests. Never raises."""
    if sys.platform != "linux":
        yield Check("vcan", "note", f"vcan exists on Linux only, and this is {sys.platform}", _UDP)
        return
    from tipforce_tools.vcan.parts import ELSEWHERE
    from tipforce_tools.vcan.run import choose

    place = choose(INTERFACES)
    try:
        code = (try_it or trial)()
    except TipforceError as error:
        yield Check("vcan", "note", str(error).splitlines()[0], "`tipforce vcan -- true` shows the details")
        return
    if code:
        yield Check("vcan", "note", f"`tipforce vcan -- true` ended with {code}", ELSEWHERE)
        return
    yield Check("vcan", "ok", f"`tipforce vcan` works: vcan0 and vcan1, {_PLACES[place]}")


def multicast_checks() -> Iterator[Check]:
    """Yield one check: open the bus of UDP datagrams, without sending. Never raises."""
    from tipforce.host.network.open_bus import open_bus

    try:
        open_bus(interface="udp_multicast", channel="239.74.163.2").shutdown()
    except TipforceError as error:
        yield Check("UDP bus", "note", str(error))
        return
    yield Check("UDP bus", "ok", f"{_UDP} between programs, where vcan is not available")
