"""Conformance cases and the conversations of ``micropython.scripts``, with the firmware between fake chips; recorded.

On CPython a plain device stands beside the firmware and gets the same frames and readings: what the fake bus carries
must be what it says. So the drivers, the loop and the flash store neither lose nor change anything."""

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pytest

from canopen_conformance.case import Case
from canopen_conformance.run import FAIL
from canopen_device.testing import Conversation, Frame, MemoryStore
from conformance.fingertip import SERIAL, run_in_process
from fingertip.finger import forces
from microcontroller import rig
from micropython import scripts
from micropython.recording import SYNC, Recording, Talk
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Reading, Source
from tipforce.sensor.structure.strain import FABRICATED, strain_matrix

COUNTS_PER_MICROSTRAIN = 1024.0
SLOWER = {"nau7802": 4, "ads1220": 1, "hx711": 16}  # SYNCs stay apart by more than a conversion
_CONTROLLER = {0x01: "overrun", 0x30: "passive", 0x40: "active", 0x08: "warning"}


class _Tap(Source):
    """Gives the plain device what the firmware's gauges gave."""

    def __init__(self, gauges: Any) -> None:
        self._gauges = gauges
        self._found: list[Reading | None] = []
        self.converter = gauges.converter
        self.count_min, self.count_max = gauges.count_min, gauges.count_max
        self._read = gauges.read
        gauges.read = self._note

    def _note(self, now_us: int) -> Reading | None:
        self._found.append(self._read(now_us))
        return self._found[-1]

    def read(self, _now_us: int) -> Reading | None:
        return self._found.pop(0)

    def due_us(self, now_us: int) -> int:
        return int(self._gauges.due_us(now_us))

    @property
    def period_us(self) -> int:
        return int(self._gauges.period_us)

    @period_us.setter
    def period_us(self, value: int) -> None:
        pass


class RecordedFirmware:
    """The firmware as a device to talk with; each step is noted with its answer."""

    def __init__(
        self, name: str, adc: str, can: str, node_id: int = 5, n: int = 3, groups: dict[str, str] | None = None,
        now_us: int = 0, serial: int = 0x01020304,
    ) -> None:  # fmt: skip
        header = {
            "node_id": node_id, "serial": serial, "n": n, "adc": adc, "can": can, "now_us": now_us + rig.WARM_UP_US,
            "counts_per_microstrain": COUNTS_PER_MICROSTRAIN, "groups": groups or {},
        }  # fmt: skip
        self.recording = Recording(f"{name}, {adc}, {can}", header)
        self.rig = rig.Rig(json.loads(json.dumps(header)))
        self.pending: list[str] = []  # what happens at the next step besides frames
        firmware = self.rig.firmware
        self._store = MemoryStore()
        self._store.groups |= {name: bytes.fromhex(content) for name, content in (groups or {}).items()}
        # Readings pass through the tap in the order in which the two devices ask: both are built first.
        self._plain = fingertip_node(node_id, _Tap(firmware.gauges), n, serial, self._store.save, self._store.load)
        self._plain.lss.bit_rate = rig.BIT_RATE
        self._came: list[Frame] = []
        receive = firmware.port.receive

        def noted() -> list[Frame]:
            self._came = receive()
            return self._came

        firmware.port.receive = noted  # type: ignore[method-assign]

    @property
    def node_id(self) -> int:
        return self.rig.firmware.device.node_id

    def step(self, now_us: int, frames: Iterable[Frame] = ()) -> tuple[list[Frame], int]:
        words = [str(now_us + rig.WARM_UP_US), *self.pending, *(self._word(*frame) for frame in frames)]
        self.pending = []
        step = " ".join(words)
        answer = self.rig.step(step)
        sent, wait_us = self.recording.note(step, answer, self.rig.stored())
        self._compare(now_us + rig.WARM_UP_US, sent)
        return sent, now_us + wait_us

    def _word(self, can_id: int, data: bytes) -> str:
        """A frame, or what an error frame says of the controller."""
        if not can_id & 0x20000000:
            return f"{can_id:X}#{bytes(data).hex()}"
        return "!off" if can_id & 0x40 else "!active" if can_id & 0x100 else f"!{_CONTROLLER[data[1]]}"

    def _compare(self, now_us: int, sent: list[Frame]) -> None:
        said, _due = self._plain.step(now_us, self._came)
        self._plain.requests.clear()
        if now_us >= self.rig.firmware._mute_until_us:
            assert sent == [(can_id, bytes(data)) for can_id, data in said], self.recording.steps[-1]
        assert {name: self.rig.store.load(name) for name in self._store.groups} == self._store.groups

    def stored(self) -> dict[str, str]:
        return {name: content.hex() for name, content in self._store.groups.items()}


def firmware_talk(adc: str, can: str) -> type[Talk]:
    """A Talk that speaks with the firmware; what a script asks of the simulation is done to the fake chips."""

    class FirmwareTalk(Talk):
        def __init__(
            self, name: str, node_id: int = 5, layout: str | Sequence[str] = "I", store: dict[str, str] | None = None,
            now_us: int = 0,
        ) -> None:  # fmt: skip
            self._rows = strain_matrix(FABRICATED, layout)
            self.recorded = RecordedFirmware(name, adc, can, node_id, len(self._rows), store, now_us)  # type: ignore[assignment]
            self._load = [0.0, 0.0, 0.0]
            self._fault = [0, 1, 0.0]
            Conversation.__init__(self, self.recorded, now_us, emcy=True)

        def put(self, kind: str, index: int, sub: int, value: float) -> int:
            if index not in (0x2200, 0x2201):
                return super().put(kind, index, sub, value)
            (self._fault if index == 0x2200 else self._load)[sub - 1] = value
            self._apply()
            return 0

        def _apply(self) -> None:
            F = forces((self._load[0], self._load[1], self._load[2]))
            counts = [round(COUNTS_PER_MICROSTRAIN * 1e6 * float(row @ F)) for row in self._rows]
            counts = [max(-0x800000, min(0x7FFFFF, one)) for one in counts]
            fault, gauge = self._fault[0], int(self._fault[1]) - 1
            if fault in (2, 3):
                counts[gauge] = 0x7FFFFF
            pending = self.recorded.pending
            pending += ["@" + ",".join(map(str, counts)), "!silent" if fault == 4 else "!speaking"]

        def sync(self, count: int = 1, period_us: int = 1000) -> list[Frame]:
            sent: list[Frame] = []
            for _ in range(count):
                self.advance(SLOWER[adc] * period_us)
                sent = self.step([SYNC])
            return sent

    return FirmwareTalk


def spoken(adc: str, can: str, wanted: Iterable[Callable[[], list[Recording]]]) -> list[Recording]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scripts, "Talk", firmware_talk(adc, can))
        return [one for script in wanted for one in script()]


def examined(adc: str, can: str, cases: Sequence[Case]) -> list[Recording]:
    """Conformance cases with the firmware. They may fail that want 16 bits, or a conversion for each SYNC."""
    devices = [RecordedFirmware(case.name, adc, can, serial=SERIAL) for case in cases]
    results = [run_in_process(case, device)[0] for case, device in zip(cases, devices, strict=True)]
    failed = [result.case.name for result in results if result.verdict == FAIL]
    assert [name for name in failed if name.split(".")[0] not in ("profile_404", "interrupts_404")] == []
    return [device.recording for device in devices]
