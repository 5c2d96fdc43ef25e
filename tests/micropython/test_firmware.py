"""The firmware loop of docs/firmware.md runs on MicroPython as it is printed there."""

from pathlib import Path

from micropython import engine

DOCUMENT = Path(__file__).parents[2] / "docs/firmware.md"
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
