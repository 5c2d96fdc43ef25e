"""Node guarding and life guarding (CiA 301, 7.2.8.2.2 and 7.2.8.3.2.1)."""

from __future__ import annotations

from canopen_conformance.case import Service
from canopen_conformance.dut import OPERATIONAL, RESET_COMMUNICATION, START, STOP, STOPPED, Dut
from canopen_conformance.raw_frames import REMOTE_FLAG

case = Service("node_guarding")

GUARDING = ((0x100C, 0), (0x100D, 0), (0x1017, 0))


def guard(dut: Dut, wanted: str) -> None:
    """The guarding master's remote frame, and the answer."""
    dut.send(0x700 + dut.node_id | REMOTE_FLAG)
    dut.expect(0x700 + dut.node_id, wanted)


def life(dut: Dut, guard_ms: int, factor: int) -> None:
    """No heartbeat; this life time."""
    dut.put("H", 0x1017, 0, 0)
    dut.put("H", 0x100C, 0, guard_ms)
    dut.put("B", 0x100D, 0, factor)
    dut.forget()


@case("CiA 301 7.2.8.3.2.1", "the answer carries the state; the toggle bit starts at 0 and alternates", needs=GUARDING)
def toggle(dut: Dut) -> None:
    life(dut, 0, 0)
    for wanted in ("7F", "FF", "7F", "FF"):
        guard(dut, wanted)


@case(
    "CiA 301 7.2.8.3.2.1",
    "guarding in {1}",
    needs=GUARDING,
    each=[(OPERATIONAL, "OPERATIONAL"), (STOPPED, "STOPPED")],
)
def guarding_state(dut: Dut, state: int, _name: str) -> None:
    life(dut, 0, 0)
    guard(dut, "7F")
    dut.enter(state)
    guard(dut, f"{state | 0x80:02X}")
    guard(dut, f"{state:02X}")


@case("CiA 301 7.2.8.3.2.1", "reset communication sets the toggle bit to 0", needs=GUARDING)
def toggle_reset(dut: Dut) -> None:
    life(dut, 0, 0)
    guard(dut, "7F")
    dut.reset(RESET_COMMUNICATION)
    life(dut, 0, 0)
    guard(dut, "7F")


@case("CiA 301 7.2.8.2.2.2", "the life time runs out: EMCY 8130h; the next remote frame cures", needs=GUARDING)
def life_lost(dut: Dut) -> None:
    life(dut, 30, 2)
    guard(dut, "7F")
    start_us = dut.now_us
    frame = dut.expect(0x80 + dut.node_id, "30 81 *", 120)
    dut.check_ms("life time", frame.at_us - start_us, 60)
    guard(dut, "FF")
    dut.expect(0x80 + dut.node_id, "00 00 *")


@case("CiA 301 7.2.8.2.2.2", "remote frames in time: no life guarding error", needs=GUARDING)
def life_in_time(dut: Dut) -> None:
    life(dut, 50, 3)
    for wanted in ("7F", "FF", "7F"):
        guard(dut, wanted)
        dut.silence(0x80 + dut.node_id, ms=80)


@case("CiA 301 7.2.8.2.2.2", "no life guarding before the first remote frame, nor with {0}", needs=GUARDING, each=[
    ("guard time 0", 0, 3), ("life time factor 0", 20, 0),
])  # fmt: skip
def life_off(dut: Dut, _which: str, guard_ms: int, factor: int) -> None:
    life(dut, 20, 1)
    dut.silence(0x80 + dut.node_id, ms=60)
    life(dut, guard_ms, factor)
    guard(dut, "7F")
    dut.silence(0x80 + dut.node_id, ms=90)


@case("CiA 301 7.5.2.11", "guard time set to 0 ends life guarding that runs", needs=GUARDING)
def life_ended(dut: Dut) -> None:
    life(dut, 60, 1)
    guard(dut, "7F")
    dut.put("H", 0x100C, 0, 0)
    dut.silence(0x80 + dut.node_id, ms=120)


@case("CiA 301 7.2.8.2.2", "a heartbeat that is switched on ends life guarding that runs", needs=GUARDING)
def heartbeat_ends_life(dut: Dut) -> None:
    life(dut, 60, 1)
    guard(dut, "7F")
    dut.put("H", 0x1017, 0, 5000)
    dut.silence(0x80 + dut.node_id, ms=120)


@case("CiA 301 7.5.2.32", "life guarding lost in OPERATIONAL: PRE-OPERATIONAL", needs=(*GUARDING, (0x1029, 1)))
def life_behaviour(dut: Dut) -> None:
    dut.put("B", 0x1029, 1, 0)
    life(dut, 30, 1)
    dut.nmt(START)
    guard(dut, "05")
    dut.expect(0x80 + dut.node_id, "30 81 *", 100)
    guard(dut, "FF")


@case("CiA 301 7.2.8.3.2.1", "a data frame on the guarding identifier is not answered", needs=GUARDING)
def no_guard(dut: Dut) -> None:
    life(dut, 0, 0)
    dut.nmt(STOP)
    dut.send(0x700 + dut.node_id)
    dut.silence(0x700 + dut.node_id)
