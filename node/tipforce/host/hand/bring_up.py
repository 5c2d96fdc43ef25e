"""Bring up a hand from powered nodes: find, assign node-ids, configure, verify, calibrate, start. Fingers are brought
up in parallel; one that fails does not block the others. Its report names the failed step."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from canopen_device.core import codes, communication
from canopen_device.types import Value
from tipforce.dictionary import objects, table
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError, NoResponseError, RefusedError, TipforceError
from tipforce.host.configuration.configuration_file import Configuration, apply_differences, verify_configuration
from tipforce.host.configuration.device_objects import FingertipObjects
from tipforce.host.decoding.duplicates import of_product
from tipforce.host.hand.events import Event, Kind
from tipforce.host.hand.file import FingerPlan, HandFile
from tipforce.host.hand.meaning import set_overflow
from tipforce.host.network.bus import Bus
from tipforce.host.network.bus_load import HEALTH_MS
from tipforce.host.network.find import FIND_S, command_and_wait, responding_nodes
from tipforce.host.network.finger import Finger, Identity
from tipforce.host.network.lss import LssMaster
from tipforce.host.network.sdo import SdoChannel

STEPS = ("find", "identity", "configure", "verify", "calibrate", "start")
NOT_CALIBRATED = "not calibrated: P, phi and theta are unknown; the hand file names no calibration"
BOOT_S = 1.0  # from the assignment of a node-id to the boot-up message
SIDE_BY_SIDE = 8

T = TypeVar("T")
OnEvent = Callable[[Event], None]


@dataclass(slots=True)
class FingerReport:
    """Progress of one finger; ``failed`` is the failed step of STEPS, "" if all succeeded."""

    plan: FingerPlan
    failed: str = ""
    error: str = ""
    done: list[str] = field(default_factory=list)
    note: str = ""
    """What the user must know of a finger that is up: it is not calibrated."""
    seconds: float = 0.0

    @property
    def ok(self) -> bool:
        """True if the finger is operational."""
        return not self.failed

    def __str__(self) -> str:
        up = f"up, {self.note}" if self.note else "up"
        return f"{self.plan.label}: " + (up if self.ok else f"failed at {self.failed}: {self.error}")


def bring_up(connection: Bus, hand: HandFile, on_event: OnEvent) -> tuple[list[FingerReport], set[int]]:
    """Return a report for each finger, in file order, and the node-ids on the bus. Raises InputError for the file."""
    plans = {finger.node_id: wanted_settings(hand, finger) for finger in hand.finger}
    for finger in hand.finger:
        connection.nmt("preop", finger.node_id)  # no PDOs during configuration; SDO works, also after a stop
    reports = [FingerReport(finger) for finger in hand.finger]
    nodes = responding_nodes(connection)
    for report in reports:
        report.seconds += FIND_S
        if report.plan.node_id in nodes:
            _attempt(report, "find", connection.sdo(report.plan.node_id).check_duplicates, on_event)
    absent = [report for report in reports if report.plan.node_id not in nodes]
    if absent:
        assign(connection, absent, hand.hand.store, on_event)
    side_by_side(
        lambda report: set_up(connection, hand, report, plans[report.plan.node_id], on_event),
        [report for report in reports if report.ok],
    )
    return reports, nodes


def wanted_settings(hand: HandFile, finger: FingerPlan) -> Configuration:
    """Return the settings of a finger in the file, with SYNC, PDOs, EMCY and heartbeat of the hand added."""
    settings = FingertipObjects(finger.node_id, finger.gauges).settings
    wanted = {
        place: (settings[place], settings[place].default)
        for place in ((communication.COB_ID_SYNC, 0), (communication.COB_ID_EMCY, 0))
    } | hand.configuration(finger)

    def want(index: int, sub: int, value: Value) -> None:
        wanted[index, sub] = settings[index, sub], value

    for number, message in enumerate(tpdo_messages(finger.gauges)):
        used = message.name in hand.messages or message.name == "Health"
        index, mapping = communication.TPDO + number, communication.TPDO_MAPPING + number
        if message.cob_id_base and (index, 1) not in wanted:
            cob_id = message.cob_id_base + finger.node_id | codes.NO_RTR | (0 if used else codes.COB_ID_INVALID)
            want(index, 1, cob_id)
            want(index, 2, message.transmission_type)
        if used:  # rows are decoded by this mapping; an inhibit time or a start value would leave SYNCs unanswered
            want(mapping, 0, len(message.mapping))
            for sub, (mapped, of, bits) in enumerate(message.mapping, start=1):
                want(mapping, sub, mapped << 16 | of << 8 | bits)
            want(index, 3, 0)
            want(index, 5, HEALTH_MS if message.event_timer_ms else 0)
            want(index, 6, 0)
    want(communication.PRODUCER_HEARTBEAT, 0, hand.hand.heartbeat_ms)
    return dict(sorted(wanted.items()))


def set_up(
    connection: Bus, hand: HandFile, report: FingerReport, wanted: Configuration, on_event: OnEvent,
    before_start: Callable[[Finger], None] = lambda _finger: None,
) -> None:  # fmt: skip
    """Run the steps from identity to start on a node with its node-id; also after a reboot. Errors go to the report."""
    plan, started_s = report.plan, time.monotonic()
    finger = connection.finger(plan.node_id)
    written: Configuration = {}

    def configure() -> str:
        written.update(apply_differences(finger.sdo, wanted))
        return f"{len(wanted)} settings"

    steps: tuple[tuple[str, Kind, Callable[[], str | None]], ...] = (
        ("identity", "found", lambda: _identity(finger, plan)),
        ("configure", "configured", configure),
        ("verify", "verified", lambda: _verify(finger.sdo, written)),
        ("calibrate", "calibrated", lambda: _calibrate(finger, hand, report)),
        ("start", "started", lambda: _start(connection, hand, finger, before_start)),
    )
    for step, kind, act in steps:
        text = _attempt(report, step, act, on_event)
        if report.failed:
            break
        if text:
            on_event(Event(time.monotonic(), plan.node_id, kind, text))
    report.seconds += time.monotonic() - started_s


def assign(connection: Bus, absent: Sequence[FingerReport], store: bool, on_event: OnEvent) -> None:
    """Assign node-ids by LSS: to the serial in the file, otherwise to unconfigured nodes in their order."""
    with LssMaster(connection) as master:
        for report in sorted(absent, key=lambda r: not r.plan.serial):
            plan = report.plan
            text = _attempt(report, "find", partial(_assign_one, connection, master, plan, store), on_event)
            if text:
                on_event(Event(time.monotonic(), plan.node_id, "assigned", text))


def _assign_one(connection: Bus, master: LssMaster, plan: FingerPlan, store: bool) -> str:
    address = select(master, plan) or select(master, plan)  # a response may be late, or lost: then it was silence
    if address is None:
        who = f"a node with serial {plan.serial}" if plan.serial else "a node without a node-id"
        raise NoResponseError(
            f"no response from node-id {plan.node_id}, and {who} does not respond to LSS: check its power"
        )
    former = master.node_id()
    master.configure_node_id(plan.node_id)
    if store:
        master.store()
    since_s = time.monotonic()
    master.release()
    if former != codes.LSS_UNCONFIGURED:
        connection.nmt("reset-comm", former)
    if not connection.heartbeats.wait(plan.node_id, codes.INITIALISING, since_s, BOOT_S):
        raise NoResponseError(f"{address} did not boot with its new node-id {plan.node_id} within {BOOT_S:g} s")
    return f"{address}: node-id {plan.node_id}" + (f", before {former}" if former != codes.LSS_UNCONFIGURED else "")


def select(master: LssMaster, plan: FingerPlan) -> Identity | None:
    """Return the node of this serial, real or simulated; without a serial the next one without a node-id."""
    for simulated in (False, True):
        product = table.product_code(plan.gauges, simulated)
        if plan.serial:
            address = Identity(0, product, table.REVISION, plan.serial)
            if master.select(address):
                return address
        else:
            unconfigured = master.fastscan((0, product, table.REVISION))
            if unconfigured is not None:
                return unconfigured
    return None


def _attempt(report: FingerReport, step: str, act: Callable[[], str | None], on_event: OnEvent) -> str | None:
    try:
        text = act()
    except TipforceError as error:
        report.failed, report.error = step, str(error)
        on_event(Event(time.monotonic(), report.plan.node_id, "failed", f"{step}: {error}"))
        return ""
    report.done.append(step)
    return text


def _identity(finger: Finger, plan: FingerPlan) -> str:
    identity = finger.identity()
    if not identity.is_fingertip or identity.gauges != plan.gauges:
        raise InputError(f"product code 0x{identity.product:08X}: expected a fingertip of {plan.gauges} gauges")
    if plan.serial and identity.serial != plan.serial:
        command = f"`tipforce lss assign {plan.node_id} --serial {plan.serial}{of_product(identity.product)}`"
        raise InputError(
            f"serial is {identity.serial}, expected {plan.serial}: check for swapped fingers; {command} assigns the "
            "node-id to the right one"
        )
    return f"{'simulated ' if identity.simulated else ''}fingertip, serial {identity.serial}"


def _verify(sdo: SdoChannel, wanted: Configuration) -> None:
    differences = verify_configuration(sdo, wanted)
    if differences:
        first = differences[0]
        raise RefusedError(
            f"{len(differences)} settings differ from those written: {first['object']} is {first['found']}, "
            f"expected {first['expected']}"
        )


def _calibrate(finger: Finger, hand: HandFile, report: FingerReport) -> str:
    """Compare by CRC-32: an equal calibration is kept, any other is replaced; a node without one gets one."""
    plan = report.plan
    calibration = hand.calibration(plan)
    active = finger.sdo.read(objects.CALIBRATION_ACTIVE_CRC)
    if calibration is None:
        report.note = "" if active else NOT_CALIBRATED
        return report.note or f"its own calibration, CRC-32 0x{active:08X}"
    if active == calibration.crc32() and not finger.verify_calibration(calibration):
        return f"{plan.calibration}: CRC-32 0x{active:08X} is already active"
    finger.apply_calibration(calibration, store=hand.hand.store)
    return f"{plan.calibration}: CRC-32 0x{calibration.crc32():08X} applied"


def _start(connection: Bus, hand: HandFile, finger: Finger, before_start: Callable[[Finger], None]) -> str:
    if hand.hand.store:
        overflow = set_overflow(finger.sdo, 0)  # the numbering of SYNCs is never stored
        finger.store()
        set_overflow(finger.sdo, overflow)
    before_start(finger)
    command_and_wait(connection, "start", [finger.node_id], max(1.0, 5e-3 * hand.hand.heartbeat_ms))
    return "operational"


def side_by_side(act: Callable[[T], None], of: Sequence[T]) -> None:
    """Do something with each finger, in parallel."""
    with ThreadPoolExecutor(SIDE_BY_SIDE, thread_name_prefix="bring-up") as pool:
        list(pool.map(act, of))
