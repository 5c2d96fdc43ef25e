"""The firmware between fake chips, as a recording says; runs on CPython and on MicroPython, like ``on_node.py``.

A step is "now_us [@counts,counts,...] [!what] frame frame ...": what the inputs of the converters are from then on,
what happens to the controller or to the chips, and what comes from the bus."""

import binascii
import json

from firmware.ads1220 import Ads1220
from firmware.app import Clock, Firmware
from firmware.can_machine import MachineCan
from firmware.can_mcp2515 import Mcp2515
from firmware.can_pyb import PybCan
from firmware.hx711 import Hx711
from firmware.nau7802 import Nau7802
from firmware.source import Gauges
from microcontroller import fake_controllers, fakes
from tipforce_loader.flash import FlashStore

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

BIT_RATE = 500000
WARM_UP_US, WARM_UP_STEP_US = 500000, 1000
STATES = ("active", "warning", "passive", "off")


def chip(kind: str, clock: "fakes.FakeClock", signal: "list[int]") -> "tuple[Any, Any]":
    if kind == "nau7802":
        nau = fakes.FakeNau7802(clock, signal)
        return Nau7802(nau, channels=len(signal)), nau
    if kind == "ads1220":
        ads = fakes.FakeAds1220(clock, signal, offset=-321, temperature=25 * 32)
        return Ads1220(ads, ads.cs, ads.drdy, channels=len(signal), rate=2000), ads
    hx = fakes.FakeHx711(clock, signal)
    return Hx711(hx.dout, hx.sck), hx


def controller(kind: str) -> "tuple[Any, Any]":
    if kind == "mcp2515":
        mcp = fake_controllers.FakeMcp2515()
        return Mcp2515(mcp, mcp.cs, BIT_RATE), mcp
    if kind == "machine":
        machine = fake_controllers.FakeMachineCan()
        return MachineCan(machine, BIT_RATE), machine
    pyb = fake_controllers.FakePybCan()
    return PybCan(pyb, BIT_RATE), pyb


class Rig:
    """Firmware and fakes. ``header``: node_id, serial, n, adc, can, now_us, counts_per_microstrain, groups as hex."""

    def __init__(self, header: "dict[str, Any]") -> None:
        # The chips start first: the node's own life begins when they are warm, WARM_UP_US or later.
        self.clock = fakes.FakeClock(header["now_us"] - WARM_UP_US)
        self.signals = [[0] for _ in range(header["n"])]
        pairs = [chip(header["adc"], self.clock, signal) for signal in self.signals]
        self.chips = [pair[1] for pair in pairs]
        gauges = Gauges([pair[0] for pair in pairs], header["counts_per_microstrain"])
        for _ in range(WARM_UP_US // WARM_UP_STEP_US):
            self.clock.now_us += WARM_UP_STEP_US
            gauges.poll(self.clock.now_us)
        self.port, self.bus = controller(header["can"])
        self.slots = fakes.MemorySlots()
        self.store = FlashStore(self.slots)
        for name in sorted(header["groups"]):
            self.store.save(name, binascii.unhexlify(header["groups"][name]))
        clock = Clock(self.clock.ticks, self.clock.diff, header["now_us"])
        self.firmware = Firmware(header["node_id"], gauges, self.port, self.store, header["serial"], clock)

    def step(self, line: str) -> str:
        """Do what the line says, go around once; due time, frames on the bus, what was written."""
        words = line.split()
        self.clock.now_us = int(words[0])
        for word in words[1:]:
            if word[0] == "@":
                for signal, counts in zip(self.signals, word[1:].split(",")):  # noqa: B905
                    signal[0] = int(counts)
            elif word[0] == "!":
                self._happen(word[1:])
            elif self.bus.error != 3:  # a controller that is off hears nothing
                can_id, data = word.split("#")
                self.bus.coming.append((int(can_id, 16), binascii.unhexlify(data)))
        wait_us = self.firmware.poll()
        sent, self.bus.sent = self.bus.sent, []
        shown = [str(wait_us)]
        shown += ["%X#%s" % (can_id, binascii.hexlify(data).decode()) for can_id, data in sent]
        return " ".join(shown)

    def _happen(self, what: str) -> None:
        if what in STATES:
            self.bus.error = STATES.index(what)
        elif what == "overrun":
            self.bus.overrun = True
        else:  # "silent" and "speaking": the converters
            for fake in self.chips:
                fake.stuck = what == "silent"

    def stored(self) -> str:
        return " ".join([binascii.hexlify(self.slots.read(slot)).decode() or "-" for slot in (0, 1)])


class Replay:
    """A recording in a file: the first line is the header, each further one a step."""

    def __init__(self, path: str) -> None:
        self._file = open(path)  # closed with MicroPython itself
        self.rig = Rig(json.loads(self._file.readline()))

    def go(self, count: int) -> None:
        for _ in range(count):
            print(self.rig.step(self._file.readline()))

    def end(self) -> None:
        print(self.rig.stored())
