"""A node on MicroPython: its files, its memory, the documented loop, and single precision that shows the same."""

import random
from pathlib import Path

import pytest

from micropython import engine, footprint
from micropython.single_precision import compare

# A node is a server; and what devices from an EDS need, a fingertip does without.
OTHER_DEVICES = {f"canopen_device/core/{name}.py" for name in ("__init__", "sdo_client", "sync_producer", "wide_types")}


def test_the_whole_device_core_is_among_them_and_nothing_of_a_pc() -> None:
    found = {path.relative_to(engine.SOURCE).as_posix() for path in engine.on_node_files()}
    assert (
        found
        >= {str(path.relative_to(engine.SOURCE)) for path in engine.SOURCE.glob("canopen_device/core/*.py")}
        - OTHER_DEVICES
    )
    assert not found & OTHER_DEVICES
    assert found >= {f"tipforce/{name}.py" for name in ("dictionary/table", "sensor/contact/scalar", "fingertip/node")}
    assert not [name for name in found if name.startswith("canopen_device/") and "/core/" not in name]
    assert not found & {"tipforce/sensor/contact/estimate.py", "tipforce/errors.py"}


HEAP_BYTES = 180_000  # MicroPython leaves about 200 000 of an ESP32's memory
NODE_BYTES = 46_000
# MicroPython's table of names doubles, some 9 kB, while the modules are imported or while the node is built.
CODE_AND_NODE_BYTES = 164_000


@pytest.fixture(scope="module")
def used() -> footprint.Heap:
    return footprint.heap(engine.compiled(3))


def test_a_node_after_boot(used: footprint.Heap) -> None:
    assert 10_000 < used.node < NODE_BYTES, used


def test_everything_at_the_worst_moment_fits_the_heap(used: footprint.Heap) -> None:
    assert used.code > 10_000
    assert used.code + used.node < CODE_AND_NODE_BYTES, used
    assert used.code + used.node < used.peak < HEAP_BYTES, used


def test_nothing_accumulates(used: footprint.Heap) -> None:
    # What comes once (the EMCY history, a longer list) is in the first thousand steps.
    assert abs(used.after_many - used.after_some) < 500, used


DOCUMENT = Path(__file__).parents[2] / "docs/micropython.md"
BOARD = """
import firmware

class Off(Exception):
    pass

def power(frames):
    '''A bus that brings these frames, one a call, until power goes.'''
    waiting = list(frames)
    def receive(us):
        assert 0 <= us <= 100000
        if not waiting:
            raise Off
        return waiting.pop(0)
    sent, requests, groups = [], [], {}
    def save(group, data):
        groups[group] = data
        return True
    try:
        firmware.run(5, lambda: (100, -200, 300), receive, lambda *frame: sent.append(frame),
                     lambda *request: requests.append(request), save, groups.get)
    except Off:
        pass
    for can_id, data in sent:
        print('%03X#%s' % (can_id, data.hex()))
    print(requests, sorted(groups))

power([None, (0x000, b'\\1\\5'), (0x080, b''), (0x605, b'\\x23\\x10\\x10\\x01save'), (0x000, b'\\x82\\5')])
"""


def test_the_documented_firmware() -> None:
    (block,) = DOCUMENT.read_text(encoding="utf-8").split("```python\n")[1:]
    files = engine.sources() | {f"{engine.LIBRARY}/firmware.py": block.split("```")[0].encode()}
    assert engine.run(files, ["import sys", f"sys.path.append({engine.LIBRARY!r})", BOARD]) == [
        "705#00",
        # Counts of 0.1 microstrain are the gauges' INTEGER16; no calibration, so the contact is unknown.
        "185#640038ff2c010001",
        "285#0080008000800001",
        "585#6010100100000000",
        "705#00",
        "[('reset-communication', 0, 0)] ['application', 'calibration', 'communication']",
    ]


def test_the_contact_pdo_differs_by_one_unit_at_most() -> None:
    chance = random.Random(20250131)
    loads = [
        (10.0 ** chance.uniform(-1.5, 1.4), chance.uniform(-60.0, 60.0), chance.uniform(-60.0, 60.0))
        for _ in range(1000)
    ]
    found = compare(loads)
    assert found.P <= 1
    assert found.phi <= 1
    assert found.theta <= 1
    assert found.status == 0
    assert found.changed <= 20, found
