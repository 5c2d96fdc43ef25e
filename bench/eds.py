"""Devices from EDS files: time to load one, cost of SDO and SYNC beside a fingertip's, random frames.

python -m bench.eds    a generated device of 1000 objects and a shipped one, a million steps of random frames
"""

from __future__ import annotations

import statistics
import struct
import tempfile
import warnings
from functools import partial
from pathlib import Path
from random import Random

from bench.device import calibrated_node, steps
from bench.fuzz import BrokenError, require
from bench.fuzz_frames import Frames
from bench.measure import arguments, cpu_s, cpu_us, in_turns

from canopen_device.eds.load import device_of
from canopen_device.eds.reader import read_eds
from canopen_device.machine import SimulatedDevice, shipped_eds
from canopen_device.machine.cia402 import Drive
from canopen_device.testing import MemoryStore

OBJECTS, STEPS = 1000, 500_000
REPEATS = 9
ROUND_STEPS = 5000
MOST_FRAMES = 300  # sent by one step for each received: an SDO block of 127, and PDOs


def entry(name: str, data_type: int, access: str, default: str, mapping: int = 0) -> str:
    """The section of one entry."""
    return (
        f"[{name}]\nParameterName=Object {name}\nObjectType=0x7\nDataType=0x{data_type:04X}\nAccessType={access}\n"
        f"DefaultValue={default}\nPDOMapping={mapping}\n"
    )


def generated_eds(count: int = OBJECTS) -> str:
    """A device of ``count`` objects of all sizes, with two synchronous TPDOs of eight bytes, as a fingertip's."""
    text = "[FileInfo]\nFileName=generated.eds\n[DeviceInfo]\nVendorNumber=1\n[MandatoryObjects]\nSupportedObjects=0\n"
    text += entry("1000", 7, "ro", "0") + entry("1001", 5, "ro", "0") + entry("1005", 7, "rw", "0x80")
    text += entry("1006", 7, "rw", "0") + entry("1014", 7, "rw", "$NODEID+0x80") + entry("1017", 6, "rw", "0")
    text += "[1018]\nParameterName=Identity\nObjectType=9\nSubNumber=5\n" + entry("1018sub0", 5, "ro", "4")
    text += "".join(entry(f"1018sub{sub}", 7, "ro", "1") for sub in range(1, 5))
    for k, direction in ((0x1800, 0x40000180), (0x1801, 0x40000280), (0x1400, 0x200)):
        text += f"[{k:04X}]\nParameterName=PDO\nObjectType=9\nSubNumber=3\n" + entry(f"{k:04X}sub0", 5, "const", "2")
        text += entry(f"{k:04X}sub1", 7, "rw", f"$NODEID+0x{direction:X}") + entry(f"{k:04X}sub2", 5, "rw", "1")
        text += f"[{k + 0x200:04X}]\nParameterName=Map\nObjectType=8\nSubNumber=5\n"
        text += entry(f"{k + 0x200:04X}sub0", 5, "rw", "4")
        for sub in range(1, 5):
            text += entry(f"{k + 0x200:04X}sub{sub}", 7, "rw", f"0x{0x2000 + 8 * sub + 1:04X}0010")
    kinds = (5, 6, 7, 2, 3, 4, 8, 0x1B)
    for k in range(count - 13):
        text += entry(f"{0x2000 + k:04X}", kinds[k % 8], "rw", str(k % 100), 1)
    return text


def load_ms(path: Path) -> float:
    """Median CPU time to read a file and make its device."""
    return 1000 * statistics.median(cpu_s(lambda: device_of(read_eds(path, 5))) for _ in range(REPEATS))


def report_costs(path: Path) -> list[str]:
    """Cost of the generated device beside a fingertip, per frame and its answers: the least of several runs."""
    upload, download = struct.pack("<BHB4x", 0x40, 0x1017, 0), struct.pack("<BHBH2x", 0x2B, 0x1017, 0, 0)
    lines = []
    for what, frame in (("SDO upload", (0x605, upload)), ("SDO download", (0x605, download)), ("SYNC", (0x80, b""))):
        device = device_of(read_eds(path, 5))
        device.step(0)
        device.step(2, [(0, b"\x01\0")])
        answers, _ = device.step(3, [frame])
        if len(answers) != (2 if what == "SYNC" else 1):
            raise AssertionError(f"{what}: {answers}")
        works = {
            "theirs": steps([device], [frame], 3000, 2000),
            "ours": steps([calibrated_node(5)], [frame], 3000, 2000),
        }
        costs = in_turns({name: partial(cpu_us, work) for name, work in works.items()}, REPEATS)
        theirs, ours = min(costs["theirs"]), min(costs["ours"])
        lines.append(f"  {what:<14}{theirs:8.1f} us, fingertip {ours:8.1f} us: {theirs / ours:.2f} times")
    return lines


class Rig:
    """The device of a file in one round, and what must hold after each step. What it raises passes through."""

    def __init__(self, path: Path, rng: Random) -> None:
        eds, store = read_eds(path, 5), MemoryStore()
        drive = Drive() if 0x6040 in eds.objects and 0x6060 in eds.objects else None
        self._simulated = SimulatedDevice(eds, drive, None, store.save, store.load)
        self.device = self._simulated.core
        self.now_us = self.due_us = self.sdo_answers = 0
        self._frames = Frames(rng, self)
        self._simulated.step(0)

    def step(self) -> int:
        """Throw the next frames; return how many were sent."""
        pause_us, frames = self._frames.next()
        self.now_us += pause_us
        sent, self.due_us = self._simulated.step(self.now_us, frames)
        self.sdo_answers = sum(can_id == 0x580 + self.device.node_id for can_id, _ in sent)
        require(self.due_us >= self.now_us, f"due {self.due_us} at {self.now_us}")
        require(len(sent) <= MOST_FRAMES * (1 + len(frames)), f"{len(sent)} frames sent at once")
        for can_id, data in sent:
            require(0 <= can_id <= 0x7FF and len(data) <= 8, f"sent {can_id:X}#{data.hex()}")
        self.device.requests.clear()
        return len(sent)


def fuzz(path: Path, steps: int, seed: int) -> int:
    """Throw so many steps of frames at the device of a file; return how many it sent. Raises BrokenError."""
    sent_frames = 0
    for number in range(0, steps, ROUND_STEPS):
        rig = Rig(path, Random(f"{seed} {path.name} {number}"))
        try:
            sent_frames += sum(rig.step() for _ in range(min(ROUND_STEPS, steps - number)))
        except BrokenError as error:
            raise BrokenError(f"{path.name}, round {number}: {error}") from None
    return sent_frames


def main() -> None:
    arguments(__doc__).parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "generated.eds"
        path.write_text(generated_eds())
        objects = len(read_eds(path, 5).objects)
        print(f"generated device of {objects} objects: loaded in {load_ms(path):.0f} ms")
        print("\n".join(report_costs(path)), flush=True)
        for file in (path, shipped_eds("cia402")):
            print(f"  {file.name}: {STEPS} steps of frames, {fuzz(file, STEPS, seed=1)} sent, nothing raised")


if __name__ == "__main__":
    main()
