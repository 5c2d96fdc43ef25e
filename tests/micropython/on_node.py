"""What runs on MicroPython: a fingertip node is built as a recording says, and answers the recording's frames.

It knows no expected answer: it prints what the node does, and CPython compares. CPython builds its node by ``build``
too, so both run the same few lines around the core."""

import binascii
import gc
import json
import struct
import time

from tipforce.fingertip.node import fingertip_node
from tipforce.sources.simulated import SimulatedSource

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from canopen_device.core.node import Device
    from tipforce.sources.front_end import FrontEnd


class Store:
    def __init__(self, groups: "dict[str, str]") -> None:
        self.groups = {name: binascii.unhexlify(content) for name, content in groups.items()}

    def save(self, group: str, data: bytes) -> bool:
        self.groups[group] = bytes(data)
        return True

    def load(self, group: str) -> "bytes | None":
        return self.groups.get(group)

    def shown(self) -> str:
        return " ".join([name + "=" + binascii.hexlify(self.groups[name]).decode() for name in sorted(self.groups)])


def build(header: "dict[str, Any]", store: Store) -> "Device":
    """The node of a recording. ``rows`` are doubles in hex: text may be read with another last bit."""
    data = binascii.unhexlify(header["rows"])
    rows = [struct.unpack("<3d", data[k : k + 24]) for k in range(0, len(data), 24)]
    return fingertip_node(
        header["node_id"], SimulatedSource(rows, front_end=front_end(header)), len(rows), header["serial"],
        store.save, store.load, header["eds"].encode(),
    )  # fmt: skip


def front_end(header: "dict[str, Any]") -> "FrontEnd | None":
    """What a recording names of the front end; numbers in JSON are short ones, which every reader reads alike."""
    named = header.get("front_end")
    if not named:
        return None
    from tipforce.sources.front_end import Bridge, FrontEnd

    return FrontEnd(bridge=Bridge(named["bridge"]), **{key: named[key] for key in named if key != "bridge"})


def answer(device: "Device", now_us: int, frames: "list[tuple[int, bytes]]") -> str:
    """One step in one line: when the node is due, the frames it sends, what it asks of its loop."""
    sent, due_us = device.step(now_us, frames)
    words = [str(due_us)]
    words += [f"{can_id:X}#{binascii.hexlify(data).decode()}" for can_id, data in sent]
    words += [f"{what}:{value}:{delay_ms}" for what, value, delay_ms in device.requests]
    device.requests.clear()
    return " ".join(words)


class Replay:
    """A recording: the first line is JSON, each further one a step as "now_us frame frame ..."."""

    def __init__(self, path: str) -> None:
        self._file = open(path)  # noqa: SIM115 (closed with MicroPython itself)
        header = json.loads(self._file.readline())
        self._store = Store(header["store"])
        self.device = build(header, self._store)

    def go(self, count: int) -> None:
        for _ in range(count):
            words = self._file.readline().split()
            frames = []
            for word in words[1:]:
                can_id, data = word.split("#")
                frames.append((int(can_id, 16), binascii.unhexlify(data)))
            print(answer(self.device, int(words[0]), frames))

    def end(self) -> None:
        print(self._store.shown())


def heap() -> int:
    """Bytes of MicroPython's heap in use; exact after a collection, which this build makes between two calls only."""
    return gc.mem_alloc()  # type: ignore[attr-defined, no-any-return]


def microseconds(device: "Device", frame: "tuple[int, bytes]", count: int, now_us: int) -> float:
    """What a step with ``frame`` takes on average, over ``count`` steps a millisecond apart from ``now_us`` on."""
    ticks_us = getattr(time, "ticks_us", None) or _perf_counter_us
    frames = [frame]
    before = ticks_us()
    for k in range(count):
        device.step(now_us + 1000 * k, frames)
    return (ticks_us() - before) / count


def _perf_counter_us() -> int:
    return time.perf_counter_ns() // 1000
