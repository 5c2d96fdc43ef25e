"""Devices from EDS files: time to load one, cost of SDO and SYNC beside a fingertip's, random frames.

python -m bench.eds    a generated device of 1000 objects and a shipped one, a million frames
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
from bench.fuzz import require
from bench.measure import arguments, cpu_s, cpu_us, in_turns

from canopen_device.eds.load import device_of
from canopen_device.eds.reader import read_eds
from canopen_device.machine import SimulatedDevice, shipped_eds
from canopen_device.machine.cia402 import Drive
from canopen_device.testing import MemoryStore

OBJECTS, FRAMES = 1000, 500_000
REPEATS = 9
ROUND_FRAMES = 5000
MOST_STEPS = 300  # frames of one step: an SDO block of 127, and PDOs
HOT = (0x1005, 0x1006, 0x1010, 0x1011, 0x1014, 0x1016, 0x1017, 0x1019, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6040, 0x6060)


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
    text += "[1018]\nParameterName=Identity\nObjectType=9\nSubNumber=2\n" + entry("1018sub0", 5, "ro", "1")
    text += entry("1018sub1", 7, "ro", "1")
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


def frames(rng: Random, entries: list[tuple[int, int, int]], node_id: int) -> list[tuple[int, bytes]]:
    """The next frames of a master that misbehaves: requests that fit, and noise."""
    kind = rng.random()
    if kind < 0.6:
        index, sub, size = rng.choice(entries)
        if rng.random() < 0.3:
            index = rng.choice(HOT)
        value = rng.choice((0, 1, 3, 6, 7, 15, 0x1F, 0x40000080, 0x80000200 + node_id, rng.getrandbits(32)))
        if rng.random() < 0.4:
            return [(0x600 + node_id, struct.pack("<BHB4x", 0x40, index, sub))]
        return [(0x600 + node_id, struct.pack("<BHBI", 0x23 | 4 - min(size, 4) << 2, index, sub, value))]
    if kind < 0.75:
        command = rng.choice((0x00, 0x01, 0x0D, 0x10, 0x20, 0x21, 0x60, 0x70, 0x80, 0xA0, 0xA2, 0xA3, 0xC0, 0xC2, 0xC6))
        index, sub, _ = rng.choice(entries)
        return [(0x600 + node_id, struct.pack("<BHB", command, index, sub) + rng.randbytes(4))]
    if kind < 0.8:
        return [(0, bytes((rng.choice((1, 1, 1, 2, 128, 129, 130)), rng.choice((0, node_id)))))]
    can_id = rng.choice(
        (0x80, 0x80, 0x200 + node_id, 0x300 + node_id, 0x7E5, 0x700 + rng.randrange(128), rng.randrange(0x800))
    )
    return [(can_id, rng.randbytes(rng.randrange(9)))]


def fuzz(path: Path, count: int, seed: int) -> int:
    """Throw ``count`` frames at the device of a file; return how many it sent. Whatever it raises passes through."""
    sent_frames = 0
    for number in range(0, count, ROUND_FRAMES):
        rng = Random(f"{seed} {path.name} {number}")
        eds, store = read_eds(path, 5), MemoryStore()
        drive = Drive() if 0x6040 in eds.objects and 0x6060 in eds.objects else None
        device = SimulatedDevice(eds, drive, None, store.save, store.load)
        entries = [(item.index, item.sub, item.type.size or 4) for item in eds.entries()]
        now_us = 0
        device.step(0)
        for _ in range(min(ROUND_FRAMES, count - number)):
            now_us += int(rng.expovariate(1e-3))
            sent, due_us = device.step(now_us, frames(rng, entries, 5))
            at = f"{path.name}, round {number}"
            require(due_us >= now_us and len(sent) <= MOST_STEPS, f"{at}: due {due_us} at {now_us}, {len(sent)} frames")
            for can_id, data in sent:
                require(0 <= can_id <= 0x7FF and len(data) <= 8, f"{at}: sent {can_id:X}#{data.hex()}")
            sent_frames += len(sent)
            device.requests.clear()
    return sent_frames


def main() -> None:
    """Run as a command."""
    arguments(__doc__).parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "generated.eds"
        path.write_text(generated_eds())
        objects = len(read_eds(path, 5).objects)
        print(f"generated device of {objects} objects: loaded in {load_ms(path):.0f} ms")
        print("\n".join(report_costs(path)), flush=True)
        for file in (path, shipped_eds("cia402")):
            print(f"  {file.name}: {FRAMES} frames received, {fuzz(file, FRAMES, seed=1)} sent, nothing raised")


if __name__ == "__main__":
    main()
