"""Recover a finger that booted, responds again, or lost its node-id: set it up as in the hand file."""

from __future__ import annotations

import time
from collections.abc import Callable

from tipforce.device.codes import OPERATIONAL
from tipforce.dictionary import objects
from tipforce.errors import TipforceError
from tipforce.host.configuration.configuration_file import verify_configuration
from tipforce.host.hand.bring_up import FingerReport, assign, set_up, wanted_settings
from tipforce.host.hand.events import Event, Supervisor
from tipforce.host.hand.file import HandFile
from tipforce.host.network.bus import Bus

LOST = 0
"""Node-id that represents all nodes without one."""


class Mender:
    """Recover fingers for a Keeper, which calls ``mend``. ``connection`` returns the present one."""

    def __init__(
        self,
        file: HandFile,
        connection: Callable[[], Bus],
        supervisor: Supervisor,
        tell: Callable[[Event], None],
    ) -> None:
        self._file, self._connection, self._supervisor, self._tell = file, connection, supervisor, tell
        self._wanted = {finger.node_id: wanted_settings(file, finger) for finger in file.finger}
        self._plans = {finger.node_id: finger for finger in file.finger}

    def mend(self, node_id: int) -> bool:
        """Set one finger up as in the file, or those without a node-id; return True when nothing is left to do."""
        try:
            return self._find_lost() if node_id == LOST else self._mend_finger(node_id)
        except TipforceError as error:
            self._tell(Event(time.monotonic(), node_id, "failed", str(error)))
            return False

    def _mend_finger(self, node_id: int) -> bool:
        if self._supervisor.states[node_id] == OPERATIONAL and self._as_wanted(node_id):
            return True
        report = FingerReport(self._plans[node_id])
        set_up(self._connection(), self._file, report, self._wanted[node_id], self._tell)
        return report.ok or self._supervisor.states[node_id] < 0

    def _as_wanted(self, node_id: int) -> bool:
        """Return whether a finger has its settings: one that returns operational may never have rebooted."""
        sdo, calibration = self._connection().sdo(node_id), self._file.calibration(self._plans[node_id])
        if calibration is not None and sdo.read(objects.CALIBRATION_ACTIVE_CRC) != calibration.crc32():
            return False
        return not verify_configuration(sdo, self._wanted[node_id])

    def _find_lost(self) -> bool:
        from tipforce.host.network.lss import LssMaster

        with LssMaster(self._connection()) as master:
            somebody = master.any_unconfigured()
        if somebody:
            lost = [n for n, state in self._supervisor.states.items() if state < 0]
            reports = [FingerReport(self._plans[n]) for n in lost]
            assign(self._connection(), reports, self._file.hand.store, self._tell)
        return True
