"""Heartbeat, produced and consumed, and node guarding (CiA 301, 7.2.8.2.2 and 7.2.8.3.2)."""

from __future__ import annotations

from canopen_conformance.case import Service
from canopen_conformance.dut import Dut
from canopen_conformance.wire import (
    OPERATIONAL,
    PRE_OPERATIONAL,
    REMOTE_FLAG,
    RESET_COMMUNICATION,
    START,
    STOP,
    STOPPED,
    Abort,
)

heartbeat = Service("error_control")
guarding = Service("node_guarding")

PRODUCER = ((0x1017, 0),)
CONSUMER = ((0x1016, 1), (0x1014, 0), (0x1001, 0))
GUARDING = ((0x100C, 0), (0x100D, 0), (0x1017, 0))
WATCHED = 0x70  # a node-id that nobody on the bus is likely to have
BEHAVIOUR = (*CONSUMER, (0x1029, 1), (0x1017, 0))


def watch(dut: Dut, ms: int, node_id: int = WATCHED, sub: int = 1) -> None:
    """Let the device watch a node, which then says its first heartbeat."""
    dut.put("I", 0x1016, sub, node_id << 16 | ms)
    dut.send(0x700 + node_id, "05")


def lost(dut: Dut, within_ms: int = 100) -> None:
    """The device reports a lost heartbeat by EMCY, with generic and communication error in the register."""
    dut.expect(0x80 + dut.node_id, lambda d: len(d) == 8 and d[:2] == b"\x30\x81" and d[2] & 0x11 == 0x11, within_ms)


# --- producer ---------------------------------------------------------------------------------------------


@heartbeat("CiA 301 7.2.8.3.2.2", "a heartbeat each {0} ms", needs=PRODUCER, each=[(20,), (50,), (110,)])
def period(dut: Dut, ms: int) -> None:
    dut.accepts("H", 0x1017, 0, ms)
    first = dut.expect(0x700 + dut.node_id, "7F", 2 * ms)
    for _ in range(3):
        last = dut.expect(0x700 + dut.node_id, "7F", 2 * ms)
    dut.check_ms("three periods of", last.at_us - first.at_us, 3 * ms)


@heartbeat(
    "CiA 301 7.2.8.3.2.2",
    "the heartbeat in {1} carries {0:02X}h",
    needs=PRODUCER,
    each=[(PRE_OPERATIONAL, "PRE-OPERATIONAL"), (OPERATIONAL, "OPERATIONAL"), (STOPPED, "STOPPED")],
)
def heartbeat_state(dut: Dut, state: int, _name: str) -> None:
    dut.beat()
    dut.enter(state)
    dut.state(state)


@heartbeat("CiA 301 7.5.2.20", "1017h = 0 ends the heartbeat", needs=PRODUCER)
def producer_off(dut: Dut) -> None:
    dut.beat()
    dut.expect(0x700 + dut.node_id)
    dut.put("H", 0x1017, 0, 0)
    dut.forget()
    dut.silence(0x700 + dut.node_id, ms=80)


@heartbeat("CiA 301 7.5.2.20", "a new period holds from the write on", needs=PRODUCER)
def new_period(dut: Dut) -> None:
    dut.put("H", 0x1017, 0, 5000)
    dut.forget()
    dut.put("H", 0x1017, 0, 40)
    dut.expect(0x700 + dut.node_id, "7F", 40)


@heartbeat("CiA 301 7.5.2.20", "{1} bytes for 1017h are refused", needs=PRODUCER, each=[("B", 1), ("I", 4)])
def producer_size(dut: Dut, kind: str, size: int) -> None:
    dut.refuses(kind, 0x1017, 0, 100, Abort.WRONG_LENGTH, Abort.TOO_LONG if size > 2 else Abort.TOO_SHORT)


# --- consumer ---------------------------------------------------------------------------------------------


@heartbeat("CiA 301 7.5.2.19", "1016h is read back as written", needs=CONSUMER)
def consumer_read_back(dut: Dut) -> None:
    dut.put("I", 0x1016, 1, WATCHED << 16 | 1234)
    dut.holds("I", 0x1016, 1, WATCHED << 16 | 1234)


@heartbeat("CiA 301 7.5.2.19", "a node-id in two entries is refused with 06040043h", needs=(*CONSUMER, (0x1016, 2)))
def consumer_twice(dut: Dut) -> None:
    dut.put("I", 0x1016, 1, WATCHED << 16 | 1000)
    dut.refuses("I", 0x1016, 2, WATCHED << 16 | 500, Abort.INCOMPATIBLE)
    dut.holds("I", 0x1016, 2, 0)


@heartbeat("CiA 301 7.5.2.19", "the same node-id with time 0 is no second watch", needs=(*CONSUMER, (0x1016, 2)))
def consumer_twice_off(dut: Dut) -> None:
    dut.put("I", 0x1016, 1, WATCHED << 16 | 1000)
    dut.put("I", 0x1016, 2, WATCHED << 16)
    dut.put("I", 0x1016, 1, WATCHED << 16 | 500)


@heartbeat("CiA 301 7.2.8.3.2.2", "nobody is missed before a first heartbeat", needs=CONSUMER)
def not_before_first(dut: Dut) -> None:
    dut.put("I", 0x1016, 1, WATCHED << 16 | 20)
    dut.silence(0x80 + dut.node_id, ms=100)


@heartbeat("CiA 301 7.2.8.2.2.3", "a lost heartbeat: EMCY 8130h after the consumer time", needs=CONSUMER)
def lost_heartbeat(dut: Dut) -> None:
    dut.put("I", 0x1016, 1, WATCHED << 16 | 100)
    dut.send(0x700 + WATCHED, "05")
    start_us = dut.now_us
    frame = dut.expect(0x80 + dut.node_id, "30 81 *", 200)
    dut.check_ms("consumer time", frame.at_us - start_us, 100)


@heartbeat("CiA 301 7.2.8.2.2.3", "a lost heartbeat is reported once", needs=CONSUMER)
def lost_once(dut: Dut) -> None:
    watch(dut, 20)
    lost(dut)
    dut.silence(0x80 + dut.node_id, ms=80)


@heartbeat("CiA 301 7.2.8.2.2.3", "heartbeats in time: no EMCY; the time runs from the last one", needs=CONSUMER)
def in_time(dut: Dut) -> None:
    watch(dut, 150)
    for _ in range(4):
        dut.silence(0x80 + dut.node_id, ms=60)
        dut.send(0x700 + WATCHED, "05")
    dut.silence(0x80 + dut.node_id, ms=60)
    lost(dut, 200)


@heartbeat("CiA 301 7.2.7.1", "a heartbeat that returns cures: EMCY 0000h, and 1001h is clear", needs=CONSUMER)
def returned(dut: Dut) -> None:
    watch(dut, 30)
    lost(dut)
    dut.send(0x700 + WATCHED, "05")
    dut.expect(0x80 + dut.node_id, "00 00 00 *")
    dut.holds("B", 0x1001, 0, 0)


@heartbeat("CiA 301 7.2.8.2.2.3", "a heartbeat that returned is watched again", needs=CONSUMER)
def watched_again(dut: Dut) -> None:
    watch(dut, 20)
    lost(dut)
    dut.send(0x700 + WATCHED, "05")
    dut.expect(0x80 + dut.node_id, "00 00 *")
    lost(dut)


@heartbeat(
    "CiA 301 7.5.2.32",
    "1029h:1 = {0}: a lost heartbeat in {2} leads to {4}",
    needs=BEHAVIOUR,
    each=[
        (0, OPERATIONAL, "OPERATIONAL", PRE_OPERATIONAL, "PRE-OPERATIONAL"),
        (1, OPERATIONAL, "OPERATIONAL", OPERATIONAL, "OPERATIONAL"),
        (2, OPERATIONAL, "OPERATIONAL", STOPPED, "STOPPED"),
        (0, PRE_OPERATIONAL, "PRE-OPERATIONAL", PRE_OPERATIONAL, "PRE-OPERATIONAL"),
        (0, STOPPED, "STOPPED", STOPPED, "STOPPED"),
    ],
)
def behaviour(dut: Dut, value: int, before: int, _in: str, after: int, _to: str) -> None:
    dut.put("B", 0x1029, 1, value)
    dut.beat()
    dut.put("I", 0x1016, 1, WATCHED << 16 | 30)
    dut.enter(before)
    dut.send(0x700 + WATCHED, "05")
    dut.sleep(60 + dut.link.tolerance_ms)
    dut.state(after)


@heartbeat(
    "CiA 301 7.2.8.3.2.2",
    "no heartbeat: {1}",
    needs=CONSUMER,
    each=[
        ((0, "05 05"), "two bytes"),
        ((0, ""), "no data"),
        ((REMOTE_FLAG, ""), "a remote frame"),
        ((1, "05"), "of another node"),
    ],
)
def no_heartbeat(dut: Dut, frame: tuple[int, str], _why: str) -> None:
    dut.put("I", 0x1016, 1, WATCHED << 16 | 20)
    dut.send(frame[0] + 0x700 + WATCHED, frame[1])
    dut.silence(0x80 + dut.node_id, ms=80)


@heartbeat("CiA 301 7.5.2.19", "four nodes are watched, each for itself", needs=(*CONSUMER, (0x1016, 4)))
def four(dut: Dut) -> None:
    for sub in (1, 2, 3, 4):
        watch(dut, 200 if sub == 3 else 40, WATCHED + sub, sub)
    for _ in range(3):
        lost(dut)
    dut.send(0x700 + WATCHED + 3, "05")
    dut.silence(0x80 + dut.node_id, ms=50)
    lost(dut, 250)


@heartbeat("CiA 301 7.5.2.19", "an entry set to 0 is watched no more", needs=CONSUMER)
def watch_off(dut: Dut) -> None:
    watch(dut, 60)
    dut.put("I", 0x1016, 1, 0)
    dut.silence(0x80 + dut.node_id, ms=120)


@heartbeat("CiA 301 7.5.2.19", "a lost node whose entry is set to 0 is an error no more", needs=CONSUMER)
def lost_then_off(dut: Dut) -> None:
    watch(dut, 20)
    lost(dut)
    dut.put("I", 0x1016, 1, 0)
    dut.holds("B", 0x1001, 0, 0)


@heartbeat("CiA 301 7.2.8.2.1.6", "reset communication ends every watch", needs=CONSUMER)
def watch_reset(dut: Dut) -> None:
    watch(dut, 60)
    dut.reset(RESET_COMMUNICATION)
    dut.silence(0x80 + dut.node_id, ms=120)


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


@guarding(
    "CiA 301 7.2.8.3.2.1", "the answer carries the state; the toggle bit starts at 0 and alternates", needs=GUARDING
)
def toggle(dut: Dut) -> None:
    life(dut, 0, 0)
    for wanted in ("7F", "FF", "7F", "FF"):
        guard(dut, wanted)


@guarding(
    "CiA 301 7.2.8.3.2.1", "guarding in {1}", needs=GUARDING, each=[(OPERATIONAL, "OPERATIONAL"), (STOPPED, "STOPPED")]
)
def guarding_state(dut: Dut, state: int, _name: str) -> None:
    life(dut, 0, 0)
    guard(dut, "7F")
    dut.enter(state)
    guard(dut, f"{state | 0x80:02X}")
    guard(dut, f"{state:02X}")


@guarding("CiA 301 7.2.8.3.2.1", "reset communication sets the toggle bit to 0", needs=GUARDING)
def toggle_reset(dut: Dut) -> None:
    life(dut, 0, 0)
    guard(dut, "7F")
    dut.reset(RESET_COMMUNICATION)
    life(dut, 0, 0)
    guard(dut, "7F")


@guarding("CiA 301 7.2.8.2.2.2", "the life time runs out: EMCY 8130h; the next remote frame cures", needs=GUARDING)
def life_lost(dut: Dut) -> None:
    life(dut, 30, 2)
    guard(dut, "7F")
    start_us = dut.now_us
    frame = dut.expect(0x80 + dut.node_id, "30 81 *", 120)
    dut.check_ms("life time", frame.at_us - start_us, 60)
    guard(dut, "FF")
    dut.expect(0x80 + dut.node_id, "00 00 *")


@guarding("CiA 301 7.2.8.2.2.2", "remote frames in time: no life guarding error", needs=GUARDING)
def life_in_time(dut: Dut) -> None:
    life(dut, 50, 3)
    for wanted in ("7F", "FF", "7F"):
        guard(dut, wanted)
        dut.silence(0x80 + dut.node_id, ms=80)


@guarding("CiA 301 7.2.8.2.2.2", "no life guarding before the first remote frame, nor with {0}", needs=GUARDING, each=[
    ("guard time 0", 0, 3), ("life time factor 0", 20, 0),
])  # fmt: skip
def life_off(dut: Dut, _which: str, guard_ms: int, factor: int) -> None:
    life(dut, 20, 1)
    dut.silence(0x80 + dut.node_id, ms=60)
    life(dut, guard_ms, factor)
    guard(dut, "7F")
    dut.silence(0x80 + dut.node_id, ms=90)


@guarding("CiA 301 7.5.2.11", "guard time set to 0 ends life guarding that runs", needs=GUARDING)
def life_ended(dut: Dut) -> None:
    life(dut, 60, 1)
    guard(dut, "7F")
    dut.put("H", 0x100C, 0, 0)
    dut.silence(0x80 + dut.node_id, ms=120)


@guarding("CiA 301 7.2.8.2.2", "a heartbeat that is switched on ends life guarding that runs", needs=GUARDING)
def heartbeat_ends_life(dut: Dut) -> None:
    life(dut, 60, 1)
    guard(dut, "7F")
    dut.put("H", 0x1017, 0, 5000)
    dut.silence(0x80 + dut.node_id, ms=120)


@guarding("CiA 301 7.5.2.32", "life guarding lost in OPERATIONAL: PRE-OPERATIONAL", needs=(*GUARDING, (0x1029, 1)))
def life_behaviour(dut: Dut) -> None:
    dut.put("B", 0x1029, 1, 0)
    life(dut, 30, 1)
    dut.nmt(START)
    guard(dut, "05")
    dut.expect(0x80 + dut.node_id, "30 81 *", 100)
    guard(dut, "FF")


@guarding("CiA 301 7.2.8.3.2.1", "a data frame on the guarding identifier is not answered", needs=GUARDING)
def no_guard(dut: Dut) -> None:
    life(dut, 0, 0)
    dut.nmt(STOP)
    dut.send(0x700 + dut.node_id)
    dut.silence(0x700 + dut.node_id)
