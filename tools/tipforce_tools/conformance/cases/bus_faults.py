"""What the CAN controller reports: passive, overrun, bus-off (CiA 301, 7.2.7.1; SocketCAN error frames)."""

from __future__ import annotations

from canopen_conformance.case import case
from canopen_conformance.dut import OPERATIONAL, PRE_OPERATIONAL, START, Dut
from tipforce.device.codes import ERROR_FLAG

CONTROLLER, BUS_OFF, RESTARTED = 0x004, 0x040, 0x100
PASSIVE, OVERFLOW, ACTIVE = "00 30 00 00 00 00 00 00", "00 01 00 00 00 00 00 00", "00 40 00 00 00 00 00 00"
NONE = "00 00 00 00 00 00 00 00"


def report(dut: Dut, error_class: int, data: str = NONE) -> None:
    """An error frame of the controller."""
    dut.send(ERROR_FLAG | error_class, data)


@case("CiA 301 7.2.7.1", "error passive: EMCY 8120h once; active again: the cure", error_frames=True, own=True)
def passive(dut: Dut) -> None:
    report(dut, CONTROLLER, PASSIVE)
    report(dut, CONTROLLER, PASSIVE)
    dut.expect(0x80 + dut.node_id, "20 81 11 *")
    dut.silence(0x80 + dut.node_id)
    report(dut, CONTROLLER, ACTIVE)
    dut.expect(0x80 + dut.node_id, "00 00 00 *")


@case("CiA 301 7.2.7.1", "overrun: EMCY 8110h once, cured when none came for a second", error_frames=True, own=True)
def overrun(dut: Dut) -> None:
    for _ in range(3):
        report(dut, CONTROLLER, OVERFLOW)
    dut.expect(0x80 + dut.node_id, "10 81 11 *")
    dut.silence(0x80 + dut.node_id, ms=900)
    dut.expect(0x80 + dut.node_id, "00 00 00 *")


@case("CiA 301 7.2.7.1", "bus-off: silent, and EMCY 8140h when it is over", error_frames=True, own=True)
def bus_off(dut: Dut) -> None:
    dut.beat()
    report(dut, BUS_OFF)
    dut.forget()
    dut.silence(0x700 + dut.node_id, ms=50)
    report(dut, RESTARTED)
    dut.expect(0x80 + dut.node_id, "40 81 *")
    dut.ask("40 00 10 00", "43 00 10 00 *")


@case("CiA 301 7.5.2.32", "bus-off in OPERATIONAL: PRE-OPERATIONAL by 1029h", error_frames=True, own=True)
def bus_off_behaviour(dut: Dut) -> None:
    dut.beat()
    dut.nmt(START)
    dut.state(OPERATIONAL)
    report(dut, BUS_OFF)
    report(dut, RESTARTED)
    dut.state(PRE_OPERATIONAL)


@case("CiA 301 7.2.7.1", "bus-off twice in a row: both are reported", error_frames=True, own=True)
def bus_off_again(dut: Dut) -> None:
    for _ in range(2):
        report(dut, BUS_OFF)
        dut.sleep(10)
        report(dut, RESTARTED)
        dut.expect(0x80 + dut.node_id, "40 81 *")
