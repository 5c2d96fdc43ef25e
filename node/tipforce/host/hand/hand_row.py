"""Rows of a hand one by one: each finger's sample at one SYNC, by its name."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence

import numpy as np

from tipforce.host.configuration.calibration import Calibration
from tipforce.host.decoding.contacts import Contact, Status, contact_values, no_answer, status_of, uncertainties
from tipforce.host.hand.delivery import RowStream
from tipforce.host.hand.rows import NO_ANSWER, REASONS, Rows


class HandRow(Mapping[str, Contact]):
    """The contacts of all fingers at one SYNC: ``row["thumb"]``, or by node-id ``row[1]``.

    A finger without an answer is included: its ``status`` is NO_ANSWER and its values are NaN.
    """

    def __init__(self, number: int, t_s: float, contacts: Sequence[Contact], pairing: str = "numbered") -> None:
        self.number = number
        """Number of the row since the start of the hand."""
        self.t_s = t_s
        """Time of the SYNC, seconds of the epoch."""
        self.pairing = pairing
        """"numbered": each contact carries the number of this SYNC; "assumed": it came after this SYNC."""
        self.contacts = tuple(contacts)
        """In the order of the hand file."""
        self._by_name = {contact.name: contact for contact in contacts}
        self._by_id = {contact.node_id: contact for contact in contacts}

    def __getitem__(self, finger: str | int) -> Contact:
        """Return the contact of a finger, by name or node-id. Raises KeyError, whose text names the fingers."""
        found = self._by_id.get(finger) if isinstance(finger, int) else self._by_name.get(finger)
        if found is None:
            known = ", ".join(f"{contact.name} ({contact.node_id})" for contact in self.contacts)
            raise KeyError(f"{finger!r}: the hand has {known}")
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self.contacts)

    def __str__(self) -> str:
        return " | ".join(f"{contact.name}: {contact}" for contact in self.contacts)


class HandRows(Iterator[HandRow], AsyncIterator[HandRow]):
    """Rows from its creation on; see ``Hand.rows``."""

    def __init__(
        self, blocks: RowStream, node_ids: Sequence[int], names: Sequence[str],
        calibrations: Sequence[Calibration | None],
    ) -> None:  # fmt: skip
        self._blocks, self._fingers = blocks, (node_ids, names, calibrations)
        self._waiting: deque[HandRow] = deque()

    def __next__(self) -> HandRow:
        """Return the next row. Raises StopIteration when the hand has stopped, or the error that ended it."""
        while not self._waiting:
            self._waiting += rows_one_by_one(next(self._blocks), *self._fingers)
        return self._waiting.popleft()

    async def __anext__(self) -> HandRow:
        """Return the next row; the event loop runs meanwhile."""
        while not self._waiting:
            self._waiting += rows_one_by_one(await anext(self._blocks), *self._fingers)
        return self._waiting.popleft()


def rows_one_by_one(
    rows: Rows, node_ids: Sequence[int], names: Sequence[str], calibrations: Sequence[Calibration | None] = ()
) -> list[HandRow]:
    """Return each row of a block; ``names`` and ``calibrations``, for the uncertainties, as ``node_ids``."""
    names = [name or f"finger {node_id}" for name, node_id in zip(names, node_ids, strict=True)]
    calibrations = calibrations or [None] * len(names)
    found = []
    status = status_of(rows.columns, rows.counter.shape) | np.where(rows.missing, np.uint16(Status.NO_ANSWER), 0)
    gauges = [name for name in rows.columns if name[:2] == "SG" and name[2:].isdigit()]
    strain = np.stack([rows.columns[name] for name in gauges], axis=-1) if gauges else np.zeros((*status.shape, 0))
    columns = [{name: values[:, k] for name, values in rows.columns.items()} for k in range(len(names))]
    values = np.stack(
        [
            contact_values(columns[k], strain[:, k] * 1e-6, status[:, k].astype(np.uint16), calibration)
            for k, calibration in enumerate(calibrations)
        ],
        axis=1,
    )
    u = uncertainties(values, calibrations)
    for m, t_s in enumerate((rows.sync_ns * 1e-9).tolist()):
        row = []
        for k, (node_id, name) in enumerate(zip(node_ids, names, strict=True)):
            why = int(rows.reason[m, k])
            if why:
                row.append(no_answer(node_id, t_s, name, "" if why == NO_ANSWER else REASONS[why]))
                continue
            flags, microstrain = Status(int(status[m, k])), tuple(strain[m, k].tolist())
            (P, phi, theta), (u_P, u_phi, u_theta) = values[m, k].tolist(), u[m, k].tolist()
            counter = int(rows.counter[m, k])
            row.append(Contact(node_id, t_s, counter, P, phi, theta, u_P, u_phi, u_theta, flags, microstrain, name))
        found.append(HandRow(rows.first + m, t_s, row, "numbered" if rows.numbered[m] else "assumed"))
    return found
