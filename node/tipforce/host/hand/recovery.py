"""Recover a finger that booted, stopped, or lost its node-id; verify one that another master changed; in parallel."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from canopen_device.core import communication
from canopen_device.core.codes import OPERATIONAL, STOPPED
from tipforce.dictionary import objects
from tipforce.dictionary.service_texts import NMT_STATES
from tipforce.errors import NoResponseError, RefusedError, TipforceError
from tipforce.host.configuration.device_objects import Place
from tipforce.host.hand import meaning
from tipforce.host.hand.bring_up import SIDE_BY_SIDE, FingerReport, assign, select, set_up, wanted_settings
from tipforce.host.hand.events import Event, Kind, Supervisor
from tipforce.host.hand.file import HandFile
from tipforce.host.hand.rows import Collector
from tipforce.host.hand.trust import COUNTER
from tipforce.host.network.bus import Bus
from tipforce.host.network.find import command_and_wait
from tipforce.host.network.finger import Finger
from tipforce.host.network.lss import LssMaster

LOST = 0
"""Node-id that represents all nodes without one."""

RETRY_S = 0.5


class Recovery:
    """Set fingers up as in the hand file. ``connection`` returns the present one. ``overflow`` is the value of 1019h
    that the SYNC asks for; None: it is left as it is."""

    def __init__(
        self, file: HandFile, connection: Callable[[], Bus], supervisor: Supervisor, collector: Collector,
        on_event: Callable[[Event], None],
    ) -> None:  # fmt: skip
        self._file, self._connection, self._supervisor, self._on_event = file, connection, supervisor, on_event
        self._collector, self._trust = collector, collector.trust
        self._wanted = {finger.node_id: wanted_settings(file, finger) for finger in file.finger}
        self._plans = {finger.node_id: finger for finger in file.finger}
        self._overflow_before: dict[int, int] = {}
        self._silent: set[int] = set()
        self._boots: Counter[int] = Counter()
        self._set_up: dict[int, int] = {}  # after so many boot-ups
        self.overflow: int | None = None

    def recover(self, node_id: int) -> bool:
        """Set one finger up as in the file, or those without a node-id; return True when nothing is left to do."""
        try:
            return self._find_lost() if node_id == LOST else self._recover_finger(node_id)
        except TipforceError as error:
            if node_id == LOST or not self._trust.shows(node_id):  # else something was to be read besides
                self._say(node_id, "failed", str(error))
            if self._supervisor.states.get(node_id, 0) >= 0:
                return False
            self._trust.give_up(node_id)
            return True  # searched as one that is lost

    def prepare(self, node_id: int) -> None:
        """Number the SYNC of a finger that is up, and learn what its values mean. Raises as SdoChannel. A finger that
        differs from the hand file is left without a meaning."""
        self._trust.hide(node_id)
        self._number(self._connection().finger(node_id))
        self._learn(node_id)

    def restore(self, node_id: int) -> None:
        """Set 1019h as it was before the hand. Raises as SdoChannel."""
        if node_id in self._overflow_before:
            meaning.set_overflow(self._connection().sdo(node_id), self._overflow_before[node_id])

    def tare(self, node_id: int) -> str:
        """Tare a finger by the hand itself; return the tare as text. Raises as SdoChannel."""
        finger = self._connection().finger(node_id)
        known = self._trust.known(node_id)
        self._trust.hide(node_id)  # what changes now is not another's doing
        try:
            finger.tare()
            F1, F2, F3 = finger.tare_state().force_newtons
            if known:
                present = self._read(node_id)
                if meaning.differences(known, present).keys() <= meaning.TARE:  # else another's is to be decided on
                    known = present
        finally:
            if known:
                self._show(node_id, known)
        return f"tare: F1 {F1:+.3f} N, F2 {F2:+.3f} N, F3 {F3:+.3f} N are subtracted"

    def silent(self, node_id: int) -> None:
        """Note that a finger or the bus was silent: it may have booted meanwhile."""
        self._silent.add(node_id)
        self._collector.expect(node_id, False)

    def booted(self, node_id: int) -> None:
        """Note that a finger booted: it is to be set up."""
        self._boots[node_id] += 1

    def needed_places(self, node_id: int) -> list[Place]:
        """Return what decides whether a finger answers the SYNC."""
        places = [place for place in self._wanted[node_id] if place[0] <= communication.LAST]
        return [*places, (communication.SYNC_OVERFLOW, 0)]

    def _say(self, node_id: int, kind: Kind, text: str) -> None:
        self._on_event(Event(time.monotonic(), node_id, kind, text))

    def _recover_finger(self, node_id: int) -> bool:
        connection, state = self._connection(), self._supervisor.states[node_id]
        if self._trust.known(node_id) and not self._has_booted(node_id):
            if state == OPERATIONAL or state < 0:  # a silent one is tried while it may only have lost its heartbeat
                return self._verify(node_id)
            # Its health PDO, which it sends at the start, says whether something was changed.
            command_and_wait(connection, "start", [node_id], max(1.0, 5e-3 * self._file.hand.heartbeat_ms))
            self._say(node_id, "started", f"was {NMT_STATES.get(state, 'silent')}")
            return True
        boots = self._boots[node_id]
        self._trust.hide(node_id)
        if state == STOPPED:
            connection.nmt("preop", node_id)  # no SDO in STOPPED
        report = FingerReport(self._plans[node_id])
        set_up(connection, self._file, report, self._wanted[node_id], self._on_event, self._number)
        if report.ok and self._learn(node_id, set_up_now=True):
            self._set_up[node_id] = boots
            return True
        return not report.ok and self._supervisor.states[node_id] < 0

    def _has_booted(self, node_id: int) -> bool:
        """Return whether a finger booted, also where it was silent and the boot-up was lost: 2126h began again."""
        if node_id in self._silent:
            counter = self._connection().sdo(node_id).read(objects.CONFIGURATION_COUNTER)
            if counter < self._trust.known(node_id)[COUNTER]:
                self._boots[node_id] += 1
            self._silent.discard(node_id)
        return self._boots[node_id] > self._set_up.get(node_id, 0)

    def _number(self, finger: Finger) -> None:
        if self.overflow is not None:
            before = meaning.set_overflow(finger.sdo, self.overflow)
            self._overflow_before.setdefault(finger.node_id, before)

    def _learn(self, node_id: int, *, set_up_now: bool = False) -> bool:
        """Read what the values of a finger mean, and show them; False if not as in the hand file. ``set_up_now``: its
        settings have just been compared. What has no part in the values is read while they are shown."""
        plan, known = self._plans[node_id], self._trust.known(node_id)
        later: set[Place] = set()
        if set_up_now and known:
            wanted = meaning.numbers(self._wanted[node_id])
            part = self._read(node_id, meaning.of_values(plan.gauges) - wanted.keys())
            later = known.keys() - part.keys() - wanted.keys()
            present: meaning.Meaning = {**known, **wanted, **part}
        else:
            present = self._read(node_id)
        if not meaning.as_wanted(present, self._wanted[node_id], self._file.calibration(plan)):
            return False
        if changes := meaning.differences(known, present):  # lost at the reset, or stored by another before it
            return self._decide(node_id, present, changes)
        self._show(node_id, present, later)
        return True

    def _read(self, node_id: int, places: Collection[Place] | None = None) -> meaning.Meaning:
        return meaning.read_meaning(self._connection().sdo(node_id), self._plans[node_id].gauges, places)

    def _show(self, node_id: int, known: meaning.Meaning, later: Collection[Place] = ()) -> None:
        self._trust.learn(node_id, known, later)
        self._collector.expect(node_id, True)

    def _verify(self, node_id: int) -> bool:
        """Read what may be another's; the collector compares it. If it differs, read all and decide."""
        if self._trust.changed(node_id):
            present = self._read(node_id)
            return self._decide(node_id, present, meaning.differences(self._trust.known(node_id), present))
        sdo = self._connection().sdo(node_id)
        for place in self._trust.unsure(node_id):
            sdo.upload(*place)
        return True

    def _decide(self, node_id: int, present: meaning.Meaning, changes: meaning.Changes) -> bool:
        policy, known, plan = self._file.hand.foreign_changes, self._trust.known(node_id), self._plans[node_id]
        text = meaning.in_words(changes, plan.gauges)
        unusable = meaning.needed(changes, self._wanted[node_id])
        if not changes or (policy == "accept" and not unusable):
            self._say(node_id, "accepted", f"by another master: {text}" if changes else "all settings are as before")
            self._show(node_id, present)
            return True
        if policy == "restore":
            try:
                finger = self._connection().finger(node_id)
                meaning.write_back(finger, plan.gauges, known, changes, self._file.calibration(plan))
                present = self._read(node_id)
                if meaning.differences(known, present):
                    return False  # changed again meanwhile
                self._show(node_id, present)
                self._say(node_id, "restored", f"another master had changed {text}")
                return True
            except RefusedError as error:
                text = f"{text}; {error}"
        if unusable and not all(communication.is_mapping(index) for index, _ in changes):
            self._collector.expect(node_id, False)  # its PDO may be off: no row waits for it
        self._trust.refuse(node_id, changes)
        self._say(node_id, "refused", f"another master changed {text}; its values stay unknown until that is undone")
        return True

    def _find_lost(self) -> bool:
        """Search fingers that are silent: one may have another node-id, or no heartbeat."""
        lost = [self._plans[n] for n, state in self._supervisor.states.items() if state < 0]
        absent = []
        with LssMaster(self._connection()) as master:
            unconfigured = master.any_unconfigured()
            for plan in lost:
                moved = unconfigured  # whoever has no node-id may be a finger without a serial
                if plan.serial:
                    moved = select(master, plan) is not None and master.node_id() != plan.node_id
                if moved:
                    absent.append(plan)
        if absent:
            assign(self._connection(), [FingerReport(plan) for plan in absent], self._file.hand.store, self._on_event)
        for plan in lost:
            if plan not in absent and self._trust.known(plan.node_id):
                with suppress(NoResponseError):
                    self._connection().sdo(plan.node_id).read(objects.CONFIGURATION_COUNTER)
                    if self._supervisor.states[plan.node_id] < 0:  # it responds, and has not booted
                        self._recover_finger(plan.node_id)
        return True


class RecoveryQueue:
    """Run ``recover(node_id)`` for fingers that need recovery, in parallel; retry after RETRY_S until it returns True.
    A finger that needs another recovery during one gets it immediately afterwards."""

    def __init__(self, recover: Callable[[int], bool]) -> None:
        self._recover = recover
        self._pool = ThreadPoolExecutor(SIDE_BY_SIDE, thread_name_prefix="recovery")
        self._lock = threading.Lock()
        self._busy: set[int] = set()
        self._due_s: dict[int, float] = {}
        self._quiet: set[int] = set()

    def need(self, node_ids: Collection[int], *, quiet: bool = False) -> None:
        """Request the recovery of these fingers now; ``quiet``: something to read, which ``waiting`` does not count."""
        with self._lock:
            if quiet:
                self._quiet |= set(node_ids) - self._due_s.keys() - self._busy
            else:
                self._quiet -= set(node_ids)
            self._due_s |= dict.fromkeys(node_ids, 0.0)
        self.tick()

    def drop(self, node_id: int) -> None:
        """Stop retries for a finger that is lost: recovery is impossible until it sends again."""
        with self._lock:
            self._due_s.pop(node_id, None)

    def waiting(self) -> bool:
        """Return whether a recovery is active or pending."""
        with self._lock:
            return bool((self._busy | self._due_s.keys()) - self._quiet)

    def tick(self) -> None:
        """Start the recoveries that are due; call it regularly."""
        now_s = time.monotonic()
        with self._lock:
            due = [n for n, due_s in self._due_s.items() if due_s <= now_s and n not in self._busy]
            for node_id in due:
                del self._due_s[node_id]
                self._busy.add(node_id)
        for node_id in due:
            self._pool.submit(self._run, node_id)

    def close(self) -> None:
        """Start no more recoveries and wait for the active ones."""
        with self._lock:
            self._due_s.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run(self, node_id: int) -> None:
        recovered = False
        try:
            recovered = self._recover(node_id)
        finally:
            with self._lock:
                self._busy.discard(node_id)
                if recovered and node_id not in self._due_s:
                    self._quiet.discard(node_id)
                if not recovered:
                    self._due_s.setdefault(node_id, time.monotonic() + RETRY_S)
