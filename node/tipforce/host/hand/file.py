"""A hand as a TOML file (docs/hand.md): its bus, its fingers, their settings and PDOs, and the SYNC rate."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from canopen_device.paths_below import below
from canopen_device.toml_table import convert, read_table
from tipforce.arrays import whole
from tipforce.dictionary.signals import tpdo_messages
from tipforce.errors import InputError, placed
from tipforce.host.configuration.calibration import Calibration, read_calibration
from tipforce.host.configuration.configuration_file import Configuration, read_configuration

MAX_FINGERS = 32
HIGHEST_SYNC_HZ = 10_000.0
MOST_SYNCS_LATE = 120  # half the numbers of a SYNC: an answer later than that could be one to the next count
_LAYOUTS = ("I", "II", "III")


class FingerPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One ``[[finger]]``. ``serial`` 0 means any; without ``calibration`` the node keeps its own."""

    node_id: int
    name: str = ""
    serial: int = 0
    gauges: int = 3
    layout: str = ""
    calibration: str = ""
    config: str = ""

    @property
    def label(self) -> str:
        """For display: ``thumb (1)``."""
        return f"{self.name} ({self.node_id})" if self.name else f"finger {self.node_id}"


class HandPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[hand]``: settings of all fingers. ``sync_hz`` 0: another device on the bus sends the SYNC."""

    sync_hz: float = 100.0
    pdos: tuple[str, ...] = ("contact",)
    heartbeat_ms: int = 100
    numbered_sync: bool | Literal["auto"] = "auto"
    """SYNCs carry numbers; "auto": if every other node on the bus takes them (1019h over 1)."""
    foreign_changes: Literal["refuse", "accept", "restore"] = "refuse"
    """Change of a finger by another master: its values stay unknown, are taken as they are, or are written back."""
    wait_ms: int | None = None
    """How long a row waits for a late finger; None: 50, but at least two periods, and under 120."""
    config: str = ""
    store: bool = False
    """Store the settings on the nodes."""

    @property
    def wait_s(self) -> float:
        """``wait_ms`` in seconds, with its default."""
        if self.wait_ms is not None:
            return self.wait_ms * 1e-3
        period_s = 1.0 / self.sync_hz if self.sync_hz else 0.0
        return min(max(0.05, 2.0 * period_s), (MOST_SYNCS_LATE - 1) * period_s or math.inf)


class _Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    finger: tuple[FingerPlan, ...]
    hand: HandPlan = HandPlan()
    bus: dict[str, Any] = {}


class HandFile(_Content, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole file; paths in it are below its folder."""

    folder: str = ""
    """The directory of the file; not a key of the file."""

    @property
    def node_ids(self) -> tuple[int, ...]:
        """In the order of the file."""
        return tuple(finger.node_id for finger in self.finger)

    @property
    def messages(self) -> tuple[str, ...]:
        """``hand.pdos`` with the dictionary's names."""
        names = {message.name.lower(): message.name for message in tpdo_messages(3)}
        return tuple(names[pdo.lower()] for pdo in self.hand.pdos)

    def calibration(self, finger: FingerPlan) -> Calibration | None:
        """Read a finger's calibration file; None if it names none. Raises InputError."""
        if not finger.calibration:
            return None
        return read_calibration(below(self.folder, finger.calibration, f"[[finger]] {finger.label}: calibration"))

    def configuration(self, finger: FingerPlan) -> Configuration:
        """Return the settings of a finger: those of all, overridden by its own. Raises InputError."""
        wanted: Configuration = {}
        for name, place in ((self.hand.config, "[hand]"), (finger.config, f"[[finger]] {finger.label}:")):
            if name:
                path = below(self.folder, name, f"{place} config")
                wanted |= read_configuration(path, finger.node_id, finger.gauges)
        return dict(sorted(wanted.items()))


def read_hand(path: str | Path) -> HandFile:
    """Read and check a hand file. Raises InputError naming the file, the place, the value and what is allowed."""
    content = convert(_Content, read_table(path, str(path)), str(path))
    hand = HandFile(finger=content.finger, hand=content.hand, bus=content.bus, folder=str(Path(path).parent))
    with placed(str(path)):
        if "dll" in hand.bus:  # python-can runs it
            raise InputError("[bus] dll: a hand file names no program; give it in python-can's configuration")
        check_hand(hand)
    return hand


def hand_of(fingers: Mapping[str, int] | Sequence[int], plan: HandPlan) -> HandFile:
    """Return a hand without a file: node-ids, or node-ids by name. Raises InputError as ``check_hand``."""
    if not isinstance(fingers, Iterable):
        raise InputError(f"fingers {fingers!r}: allowed are a hand file, node-ids, or node-ids by name")
    named = fingers.items() if isinstance(fingers, Mapping) else [(f"finger {node_id}", node_id) for node_id in fingers]
    for name, _ in named:
        if not isinstance(name, str):
            raise InputError(f"finger {name!r}: allowed are node-ids by name, as {{'thumb': 1}}")
    plans = (FingerPlan(node_id=whole(f"finger {name!r}: node-id", number), name=name) for name, number in named)
    hand = HandFile(finger=tuple(plans), hand=plan)
    check_hand(hand)
    return hand


def check_hand(hand: HandFile) -> None:
    """Check a hand. Raises InputError for invalid values, repeated fingers, and files that cannot be read."""
    if not 1 <= len(hand.finger) <= MAX_FINGERS:
        raise InputError(f"{len(hand.finger)} [[finger]] tables: allowed are 1 to {MAX_FINGERS}")
    for what in ("node_id", "serial", "name"):
        values = [getattr(finger, what) for finger in hand.finger if getattr(finger, what)]
        twice = sorted({value for value in values if values.count(value) > 1})
        if twice:
            raise InputError(f"[[finger]] {what} = {twice[0]!r} is a duplicate")
    for finger in hand.finger:
        _check_finger(hand, finger)
    _check_plan(hand.hand)
    if len({finger.gauges for finger in hand.finger}) > 1:
        raise InputError("[[finger]] gauges: allowed is the same number for all fingers")


def _check_finger(hand: HandFile, finger: FingerPlan) -> None:
    place = f"[[finger]] {finger.name or finger.node_id}"
    for name, value, low, high in (
        ("node_id", finger.node_id, 1, 127), ("serial", finger.serial, 0, 0xFFFFFFFF), ("gauges", finger.gauges, 3, 8),
    ):  # fmt: skip
        if not low <= value <= high:
            raise InputError(f"{place}: {name} = {value}, allowed are {low} to {high}")
    if finger.layout and finger.layout not in _LAYOUTS:
        raise InputError(f"{place}: layout = {finger.layout!r}, allowed are {', '.join(_LAYOUTS)} or none")
    calibration = hand.calibration(finger)
    if calibration is not None and calibration.gauges != finger.gauges:
        raise InputError(f"{place}: {finger.calibration} has {calibration.gauges} gauges, the finger {finger.gauges}")
    hand.configuration(finger)


def _check_plan(plan: HandPlan) -> None:
    if not 0 <= plan.sync_hz <= HIGHEST_SYNC_HZ:
        raise InputError(f"[hand] sync_hz = {plan.sync_hz:g}: allowed are 0 (another sends it) to {HIGHEST_SYNC_HZ:g}")
    if not 10 <= plan.heartbeat_ms <= 65535:
        raise InputError(f"[hand] heartbeat_ms = {plan.heartbeat_ms}: allowed are 10 to 65535")
    if plan.wait_ms is not None:
        most_ms = math.ceil(1000 * MOST_SYNCS_LATE / plan.sync_hz) - 1 if plan.sync_hz else 1000
        most_ms = max(1, min(1000, most_ms))
        if not 1 <= plan.wait_ms <= most_ms:
            reason = "" if most_ms == 1000 else f" (under {MOST_SYNCS_LATE} SYNCs)"
            raise InputError(f"[hand] wait_ms = {plan.wait_ms}: allowed are 1 to {most_ms}{reason}")
    if plan.numbered_sync is True and not plan.sync_hz:
        raise InputError("[hand] numbered_sync = true with sync_hz = 0: the other device numbers its SYNC or not")
    allowed = [m.name.lower() for m in tpdo_messages(3) if m.name != "Health"]
    unknown = [pdo for pdo in plan.pdos if pdo.lower() not in allowed]
    if unknown or not plan.pdos:
        raise InputError(f"[hand] pdos = {list(plan.pdos)}: allowed are {', '.join(allowed)}")
