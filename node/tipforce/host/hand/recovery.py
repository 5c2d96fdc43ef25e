"""Recover a finger that booted, stopped, or lost its node-id; verify one that another master changed."""

from __future__ import annotations

import time
from collections.abc import Callable

from tipforce.device.codes import OPERATIONAL, STOPPED
from tipforce.dictionary import objects
from tipforce.dictionary.dbc import NMT_STATES
from tipforce.errors import RefusedError, TipforceError
from tipforce.host.hand.bring_up import FingerReport, assign, set_up, wanted_settings
from tipforce.host.hand.collector import Collector
from tipforce.host.hand.events import Event, Kind, Supervisor
from tipforce.host.hand.file import HandFile
from tipforce.host.hand.meaning import (
    IN_WORDS,
    Meaning,
    as_wanted,
    differences,
    in_words,
    meaning_entries,
    of_pdos,
    only_tare,
    read_meaning,
    set_overflow,
    write_back,
)
from tipforce.host.network.bus import Bus
from tipforce.host.network.finger import FingertipClient
from tipforce.host.network.nmt import command_and_wait

LOST = 0
"""Node-id that represents all nodes without one."""


class Recovery:
    """Set fingers up as in the hand file. ``connection`` returns the present one.

    ``overflow`` is the value of 1019h that the SYNC asks for; None: it is left as it is. ``meaning`` holds what the
    values of each finger are known to mean; while 2126h is another one the collector does not show them.
    """

    def __init__(
        self, file: HandFile, connection: Callable[[], Bus], supervisor: Supervisor, collector: Collector,
        on_event: Callable[[Event], None],
    ) -> None:  # fmt: skip
        self._file, self._connection, self._supervisor, self._on_event = file, connection, supervisor, on_event
        self._collector = collector
        self._wanted = {finger.node_id: wanted_settings(file, finger) for finger in file.finger}
        self._plans = {finger.node_id: finger for finger in file.finger}
        self._overflow_before: dict[int, int] = {}
        self._silent: set[int] = set()
        self._doubted: set[int] = set()
        self.overflow: int | None = None
        self.meaning: dict[int, Meaning] = {}

    def recover(self, node_id: int) -> bool:
        """Set one finger up as in the file, or those without a node-id; return True when nothing is left to do."""
        try:
            return self._find_lost() if node_id == LOST else self._recover_finger(node_id)
        except TipforceError as error:
            self._say(node_id, "failed", str(error))
            return False

    def prepare(self, node_id: int) -> None:
        """Number the SYNC of a finger that is up, and learn what its values mean. Raises as SdoChannel.

        One that is not as in the hand file is to be set up.
        """
        self._collector.hide(node_id)
        self._number(FingertipClient(self._connection().sdo(node_id)))
        self._learn(node_id)

    def restore(self, node_id: int) -> None:
        """Set 1019h as it was before the hand. Raises as SdoChannel."""
        if node_id in self._overflow_before:
            set_overflow(self._connection().sdo(node_id), self._overflow_before[node_id])

    def tare(self, node_id: int) -> str:
        """Tare a finger by the hand itself; return the tare as text. Raises as SdoChannel."""
        client = FingertipClient(self._connection().sdo(node_id))
        before = self.meaning.pop(node_id, None)  # what changes now is not another's doing
        try:
            client.tare()
            F1, F2, F3 = client.tare_state().force_newtons
        finally:
            if before is not None:
                found = self._read(node_id)
                self.meaning[node_id] = before
                if only_tare(differences(before, found)):  # else another's change is still to be decided on
                    self._show(node_id, found)
        return f"tare: F1 {F1:+.3f} N, F2 {F2:+.3f} N, F3 {F3:+.3f} N are subtracted"

    def silent(self, node_id: int) -> None:
        """Note that a finger or the bus was silent: it may have booted meanwhile."""
        self._silent.add(node_id)
        self._collector.expect(node_id, False)

    def doubt(self, node_id: int) -> bool:
        """Note that another master changes a finger; return False if that is known, or the hand is changing it."""
        known = node_id in self._doubted or node_id not in self.meaning
        self._doubted.add(node_id)
        return not known

    def _say(self, node_id: int, kind: Kind, text: str) -> None:
        self._on_event(Event(time.monotonic(), node_id, kind, text))

    def _recover_finger(self, node_id: int) -> bool:
        connection, state = self._connection(), self._supervisor.states[node_id]
        if node_id in self.meaning and not self._has_booted(node_id):
            if state == OPERATIONAL:
                self._number(FingertipClient(connection.sdo(node_id)))
                return self._verify(node_id)
            # Its health PDO, which it sends at the start, says whether something was changed.
            command_and_wait(connection, "start", [node_id], max(1.0, 5e-3 * self._file.hand.heartbeat_ms))
            self._say(node_id, "started", f"was {NMT_STATES.get(state, 'silent')}")
            return True
        if state == STOPPED:
            connection.nmt("preop", node_id)  # no SDO in STOPPED
        report = FingerReport(self._plans[node_id])
        set_up(connection, self._file, report, self._wanted[node_id], self._on_event, self._number)
        if report.ok:
            return self._learn(node_id)
        return self._supervisor.states[node_id] < 0

    def _has_booted(self, node_id: int) -> bool:
        """Return whether a finger that was silent lost its boot-up message too: its 2126h began again."""
        if node_id not in self._silent:
            return False
        booted = self._connection().sdo(node_id).read(objects.CONFIGURATION_COUNTER) < self.meaning[node_id].counter
        self._silent.discard(node_id)
        return booted

    def _number(self, client: FingertipClient) -> None:
        if self.overflow is not None:
            before = set_overflow(client.sdo, self.overflow)
            self._overflow_before.setdefault(client.node_id, before)

    def _learn(self, node_id: int) -> bool:
        """Read what the values of a finger mean, and show them; return False if that is not as in the hand file."""
        plan, found = self._plans[node_id], self._read(node_id)
        if not as_wanted(found, self._wanted[node_id], self._file.calibration(plan)):
            return False
        self._show(node_id, found)
        return True

    def _read(self, node_id: int) -> Meaning:
        entries = meaning_entries(self._wanted[node_id], self._plans[node_id].gauges)
        return read_meaning(self._connection().sdo(node_id), entries)

    def _show(self, node_id: int, meaning: Meaning) -> None:
        self.meaning[node_id] = meaning
        self._doubted.discard(node_id)
        self._collector.verify(node_id, meaning.counter)
        self._collector.expect(node_id, True)

    def _verify(self, node_id: int) -> bool:
        """Compare what the values of a finger mean with what the hand knows, and decide by ``foreign_changes``."""
        sdo, known = self._connection().sdo(node_id), self.meaning[node_id]
        seen = self._collector.seen(node_id)
        counter = sdo.read(objects.CONFIGURATION_COUNTER)
        if counter == known.counter:
            self._show(node_id, known)
            return True
        if counter != seen:
            return True  # the collector sees this response, too: verified when the other master is done
        found = self._read(node_id)
        changes, policy = differences(known, found), self._file.hand.foreign_changes
        text = in_words(changes)
        if not changes or (policy == "accept" and not of_pdos(changes)):
            same = f"read again: {IN_WORDS} are as before"
            self._say(node_id, "accepted", f"by another master: {text}" if changes else same)
            self._show(node_id, found)
            return True
        if policy == "restore":
            try:
                write_back(FingertipClient(sdo), known, changes, self._file.calibration(self._plans[node_id]))
                found = self._read(node_id)
                if differences(known, found):
                    return False  # changed again meanwhile
                self._show(node_id, found)
                self._say(node_id, "restored", f"another master had changed {text}")
                return True
            except RefusedError as error:
                text = f"{text}; {error}"
        if of_pdos(changes):
            self._collector.expect(node_id, False)  # its PDO may be off: no row waits for it
        self._doubted.discard(node_id)
        self._say(node_id, "refused", f"another master changed {text}; its values stay unknown until that is undone")
        return True

    def _find_lost(self) -> bool:
        from tipforce.host.network.lss import LssMaster

        with LssMaster(self._connection()) as master:
            somebody = master.any_unconfigured()
        if somebody:
            lost = [n for n, state in self._supervisor.states.items() if state < 0]
            reports = [FingerReport(self._plans[n]) for n in lost]
            assign(self._connection(), reports, self._file.hand.store, self._on_event)
        return True
