"""The conversations of the MicroPython tests: each speaks of some services of a fingertip node, from its power-on."""

import struct
from collections.abc import Callable

from canopen_device.core import codes
from canopen_device.core.sdo_client import BlockDownload, BlockUpload
from canopen_device.testing import losing
from micropython.recording import Recording, Talk
from tipforce.dictionary import table
from tipforce.dictionary.eds import eds_text

PAST_SMALL_INTEGERS_US = 1 << 41  # a node's clock after 25 days; MicroPython keeps integers beyond 2^30 on the heap


def nmt_and_sdo() -> list[Recording]:
    """Boot-up, every NMT command, heartbeat, SDO expedited and segmented, refusals, transfers that stall."""
    talk = Talk("NMT and SDO")
    for command in ("01", "02", "80", "01", "82", "81"):
        talk.send(f"000#{command}05")
        talk.upload(0x1000) if command != "02" else talk.send("605#4000100000000000")
        talk.advance(1_100_000)
    talk.send("000#0106")  # for another node
    talk.send("000#01")
    assert talk.put("H", 0x1017, 0, 100) == 0
    talk.advance(450_000)
    talk.sleep(1_000_000)
    assert talk.upload(0x1008) == b"tipforce fingertip"
    assert talk.download(0x1008, 0, b"x") == codes.READ_ONLY
    assert talk.upload(0x2104) == codes.WRITE_ONLY
    assert talk.upload(0x5000) == codes.NO_OBJECT
    assert talk.upload(0x1018, 9) == codes.NO_SUB
    assert talk.download(0x1017, 0, b"\1\2\3") == codes.TOO_LONG
    assert talk.download(0x1017, 0, b"\1") == codes.TOO_SHORT
    assert talk.put("B", 0x1019, 0, 241) == codes.TOO_HIGH
    assert talk.put("f", 0x6121, 1, float("nan")) == codes.INVALID_VALUE
    for line in (
        "605#2F17100000000000",
        "605#E000000000000000",
        "605#60",
        "605#0000000000000000",
        "605#8000000000000000",
    ):
        talk.send(line)
    talk.send("605#4008100000000000")
    talk.send("605#7000000000000000")  # toggle bit wrong
    talk.send("605#4008100000000000")
    talk.advance(1_100_000)  # stalls: time-out
    talk.send("605#214121009E000000")
    talk.send("605#0041000000000000")
    talk.advance(1_100_000)
    return [talk.recording]


def calibration() -> list[Recording]:
    """Stage, commit, lock, refuse, store, restore and reset, and what a power cycle finds; blocks both ways."""
    talk = Talk("calibration")
    talk.calibrate()
    record = talk.upload(0x2140)
    assert isinstance(record, bytes)
    assert talk.upload(0x2140, 0, BlockUpload, losing(4)) == record
    assert talk.download(0x2141, 0, record[:-4] + b"\0\0\0\0", BlockDownload, losing(6)) == 0
    assert talk.download(0x2141, 0, record, BlockDownload, _wrong_crc) == codes.BLOCK_CRC
    assert talk.download(0x2141, 0, record[:-1], BlockDownload) == codes.TOO_SHORT
    assert talk.download(0x2141, 0, record + b"\0") == codes.TOO_LONG
    assert talk.download(0x2141, 0, record) == 0
    assert talk.put("I", 0x2104, 0, 1) == codes.NOT_TRANSFERRED
    assert talk.put("f", 0x2101, 1, float("nan")) == 0
    assert talk.put("I", 0x2104, 0, table.SIGNATURE_COMMIT) == codes.INCOMPATIBLE
    assert talk.put("I", 0x2103, 1, talk.get("I", 0x2103, 2)) == 0
    assert talk.put("I", 0x2104, 0, table.SIGNATURE_COMMIT) == codes.INVALID_VALUE
    assert talk.put("B", 0x2105, 2, 1) == 0
    assert talk.put("f", 0x2101, 1, 0.0) == codes.DEVICE_STATE
    assert talk.put("I", 0x2105, 3, table.SIGNATURE_OPEN) == 0
    talk.get("f", 0x2102, 5)
    assert talk.put("H", 0x1017, 0, 250) == 0
    assert talk.put("f", 0x6133, 7, 0.25) == 0
    assert talk.put("I", 0x1010, 1, codes.SIGNATURE_SAVE) == 0
    talk.send("000#8105")
    assert talk.upload(0x2140) == record
    second = Talk("calibration, power cycle", store=talk.recorded.stored())
    assert second.upload(0x2140) == record
    assert second.get("H", 0x1017) == 250
    assert second.put("I", 0x1011, 2, codes.SIGNATURE_LOAD) == 0
    assert second.put("I", 0x1011, 4, codes.SIGNATURE_LOAD) == 0
    second.send("000#8105")
    assert second.get("I", 0x2103, 3) == 0
    damaged = {name: content[:-2] + "00" for name, content in talk.recorded.stored().items()}
    third = Talk("calibration, store damaged", store=damaged | {"calibration": "0102"})
    third.start()
    third.sync(2)
    assert third.get("I", 0x1003, 1) == 0x6320
    return [talk.recording, second.recording, third.recording]


def measurement() -> list[Recording]:
    """Loads, SYNC and TPDOs, tare and zero by SDO and RPDO, faults of the front end, EMCY and its history."""
    talk = Talk("measurement")
    talk.start()
    talk.sync(3)
    assert talk.put("I", 0x6125, 1, table.SIGNATURE_ZERO) == 0
    talk.calibrate()
    talk.load(1.0, 0.0, 0.0)
    talk.sync(3)
    assert talk.put("I", 0x6125, 1, table.SIGNATURE_ZERO) == codes.DEVICE_STATE
    for load in (
        (1.0, 10.0, 5.0),
        (0.5, -30.0, -20.0),
        (0.02, 0.0, 0.0),
        (3.0, 80.0, 85.0),
        (2.0, 0.0, 90.0),
        (300.0, 0.0, 0.0),
    ):
        talk.load(*load)
        talk.sync(3)
        for sub in (1, 2, 3):
            talk.upload(0x2107, sub)
        for index in (0x6100, 0x6130, 0x7130, 0x9130, 0x6150):
            for sub in range(1, 4 if index == 0x6100 else 10):
                talk.upload(index, sub)
    talk.load(0.0, 0.0, 0.0)
    talk.sync(2)
    assert talk.put("B", 0x1400, 2, 255) == 0
    assert talk.put("I", 0x1400, 1, 0x205) == 0
    for line in ("205#0100", "205#0200", "205#0300", "205#0400", "205#01", "205#0100"):
        talk.send(line)
        talk.sync(2)
    assert talk.put("I", 0x6139, 4, table.SIGNATURE_TARA) == 0
    talk.sync(2)
    talk.get("f", 0x2111, 1)
    talk.get("I", 0x2111, 4)
    for fault in (1, 2, 3, 4, 5, 0):
        assert talk.put("f", 0x2200, 3, 20.0) == 0
        assert talk.put("B", 0x2200, 2, 2) == 0
        assert talk.put("H", 0x2200, 1, fault) == 0
        talk.sync(40)
        talk.advance(150_000)
        talk.sync(2)
    for sub in range(9):
        talk.upload(0x1003, sub)
    assert talk.put("B", 0x1003, 0, 0) == 0
    return [talk.recording]


def pdos() -> list[Recording]:
    """Remapping with its refusals, transmission types, inhibit time, event timer, SYNC counter, interrupts."""
    talk = Talk("PDOs")
    talk.calibrate()
    talk.start()
    assert talk.put("I", 0x1A01, 1, 0x61300710) == codes.DEVICE_STATE
    talk.remap(1, 0x40000285, ((0x6130, 7, 32), (0x9130, 8, 32)))
    talk.remap(2, 0x40000385, ((0x7130, 4, 16), (0x2120, 0, 8), (0x2107, 3, 32)))
    assert talk.put("I", 0x1801, 1, 0x400006FF) == codes.INVALID_VALUE
    assert talk.put("B", 0x1801, 2, 252) == codes.INVALID_VALUE
    for transmission in (1, 3, 240, 0):
        assert talk.put("B", 0x1801, 2, transmission) == 0
        talk.load(0.1 * (1 + transmission), 12.5, -7.5)
        talk.sync(7)
    talk.remap(3, 0x40000485, ((0x7130, 7, 16), (0x7130, 8, 16)), transmission=254, inhibit=50, event_ms=20)
    assert talk.put("f", 0x6133, 7, 0.05) == 0
    assert talk.put("f", 0x6135, 8, 20.0) == 0
    assert talk.put("f", 0x6136, 8, 2.0) == 0
    for P, phi in ((0.2, 10.0), (0.22, 10.0), (0.3, 15.0), (0.3, 21.0), (0.3, 19.0), (0.3, 15.0), (0.0, 0.0)):
        talk.load(P, phi, 2.0)
        talk.advance(33_000)
        talk.sync(3)
    for value, line in ((10, "080#01"), (10, "080#02"), (10, "080#"), (0, "080#"), (0, "080#0102")):
        talk.put("B", 0x1019, 0, value)
        talk.send(line)
    assert talk.put("I", 0x1005, 0, 0x81) == 0
    talk.send("081#")
    talk.send("080#")
    talk.send("000#0205")
    talk.sync(2)
    return [talk.recording]


def network() -> list[Recording]:
    """Heartbeat consumers, guarding, TIME, EMCY inhibit, collisions, bus faults; a clock far on."""
    talk = Talk("network", now_us=PAST_SMALL_INTEGERS_US)
    talk.start()
    for sub, word in enumerate((0x6B_0064, 0x12_0064, 0x69_0064, 0x46_00C8), 1):
        assert talk.put("I", 0x1016, sub, word) == 0
    assert talk.put("I", 0x1016, 4, 0x6B_0032) == codes.INCOMPATIBLE
    assert talk.put("H", 0x1015, 0, 100) == 0
    talk.step([(0x700 + node_id, b"\5") for node_id in (0x6B, 0x12, 0x69, 0x46)])
    talk.sleep(150_000)  # three of them are missed in one step
    talk.advance(300_000)
    talk.step([(0x712, b"\5"), (0x76B, b"\5")])
    talk.advance(50_000)
    assert talk.put("I", 0x1012, 0, 0x80000100) == 0
    talk.send("100#40E20100D72E")
    talk.get("I", 0x1013)
    assert talk.put("I", 0x1013, 0, 0xFFFFFF00) == 0
    talk.advance(1000)
    talk.get("I", 0x1013)
    assert talk.put("H", 0x1017, 0, 0) == 0
    assert talk.put("H", 0x100C, 0, 50) == 0
    assert talk.put("B", 0x100D, 0, 3) == 0
    talk.start()
    for _ in range(3):
        talk.step([(0x40000705, b"")])
        talk.advance(50_000)
    talk.advance(200_000)
    talk.send("285#0011")  # another node with this node's identifier
    talk.send("585#0011")
    for class_bits, detail in ((4, 2), (4, 0x10), (4, 0x40), (0x40, 0), (0x100, 0), (4, 0x08)):
        talk.step([(0x20000000 | class_bits, bytes((0, detail, 0, 0, 0, 0, 0, 0)))])
        talk.advance(400_000)  # while the bus is off: the device asks for restarts
        talk.sync(1)
    for sub in range(9):
        talk.upload(0x1003, sub)
    return [talk.recording]


def lss() -> list[Recording]:
    """A node without a node-id: fastscan, selective, inquiry, configuration, storing; then it boots, and once more."""
    talk = Talk("LSS", node_id=255)
    assert not talk.sent
    talk.fastscan((0, 0x54500103, table.REVISION, 0x01020304))
    for line in ("5E5000000000000000", "5E5E00000000000000", "5E5A00000000000000", "5E1100000000000000"):
        talk.send("7E5#" + line[2:])
    for service in (0x5A, 0x5B, 0x5C, 0x5D, 0x5E):
        talk.step([(0x7E5, bytes((service,)) + bytes(7))])
    for request in ("1100", "1120", "13000A", "130004", "150A00", "17"):
        talk.send("7E5#" + request.ljust(16, "0"))
    talk.send("7E5#0400000000000000")
    talk.advance(1_200_000)
    assert talk.device.node_id == 0x20
    talk.start()
    talk.sync(2)
    for service, number in ((0x40, 0), (0x41, 0x54500103), (0x42, table.REVISION), (0x43, 0x01020304)):
        talk.step([(0x7E5, struct.pack("<BIxxx", service, number))])
    talk.send("7E5#5E00000000000000")
    talk.send("7E5#0400000000000000")
    for service, number in enumerate((0, 0x54500103, 0, 0xFFFFFFFF, 0, 0xFFFFFFFF), 0x46):
        talk.step([(0x7E5, struct.pack("<BIxxx", service, number))])
    talk.send("7E5#4C00000000000000")
    second = Talk("LSS, power cycle", node_id=255, store=talk.recorded.stored())
    assert second.device.node_id == 0x20
    second.advance(2_000_000)
    return [talk.recording, second.recording]


def _wrong_crc(data: bytes) -> bytes:
    return data[:1] + b"\1\0" + data[3:] if data[0] & 0xE3 == 0xC1 else data


def eds() -> list[Recording]:
    """The node's own EDS (1021h), 70 kB, by block transfer with a segment lost, and the beginning by segments."""
    text = eds_text(3, simulated=True).encode()
    talk = Talk("EDS", eds=text.decode())
    assert talk.upload(0x1021, 0, BlockUpload, losing(101)) == text
    talk.send("605#4021100000000000")
    for k in range(100):
        talk.send(f"605#{0x60 | (k & 1) << 4:02X}00000000000000")
    talk.send("605#8021100000000408")
    talk.get("H", 0x1022)
    return [talk.recording]


def many_gauges() -> list[Recording]:
    """Eight gauges: more objects, two more TPDOs, a longer record."""
    points = ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V")
    talk = Talk("eight gauges", layout=points)
    talk.calibrate(points)
    talk.start()
    for k in range(20):
        talk.load(0.3 + 0.1 * k, -40.0 + 5.0 * k, 30.0 - 3.0 * k)
        talk.sync(2)
        talk.upload(0x9130, 12)
    assert talk.put("I", 0x1010, 4, codes.SIGNATURE_SAVE) == 0
    return [talk.recording]


def judged() -> list[Recording]:
    """Gauges that contradict each other, left out and not; forces and temperatures beyond the calibration."""
    found = []
    for points in (("L", "R", "T", "U"), ("L", "R", "T", "U", "K_V"), ("L", "R", "T", "U", "K_H", "S_H", "K_V", "S_V")):
        talk = Talk(f"judged, {len(points)} gauges", layout=points)
        for sub, value in enumerate((2.0, 4.0, 10.0, 22.0, 0.001), 1):
            assert talk.put("f", 0x2112, sub, value) == 0
        for k in range(len(points)):
            assert talk.put("f", 0x2113, 1 + k, 2.5e-3) == 0
            assert talk.put("f", 0x2114, 1 + k, 1e-6 * k) == 0
        assert talk.put("f", 0x2115, 0, -3e-4) == 0
        assert talk.put("f", 0x2116, 0, 30.0) == 0
        talk.calibrate(points)
        talk.remap(3, 0x40000485, ((0x2124, 0, 16), (0x2123, 0, 16), (0x2126, 0, 8)), transmission=255)
        talk.start()
        for load in ((1.0, 10.0, 5.0), (2.5, 10.0, 5.0), (4.2, 10.0, 5.0), (3.9, 10.0, 5.0), (1.0, 170.0, 185.0)):
            talk.load(*load)
            talk.sync(3)
        for gauge in range(1, len(points) + 1):
            talk.get("H", 0x2124)
            assert talk.put("f", 0x2200, 3, 500.0) == 0  # microstrain/s
            assert talk.put("B", 0x2200, 2, gauge) == 0
            assert talk.put("H", 0x2200, 1, 5) == 0
            talk.sync(30, 2000)
            for sub in range(1, 4):
                talk.get("f", 0x2107, sub)
            for fault in (1, 2, 3, 0):
                assert talk.put("H", 0x2200, 1, fault) == 0
                talk.sync(3)
            talk.advance(150_000)
        found.append(talk.recording)
    return found


def filters() -> list[Recording]:
    """Each filter with extreme constants, under loads, saturation, silence and time asleep; stored, found again."""
    found = []
    for kind, constant in ((1, 7), (1, 256), (2, 5), (100, 3), (100, 65535)):
        talk = Talk(f"filter {kind}, {constant}", now_us=PAST_SMALL_INTEGERS_US if constant == 7 else 0)
        talk.calibrate()
        talk.start()
        assert talk.put("H", 0x61A1, 1, constant) == talk.put("B", 0x61A0, 1, kind) == 0
        for k in range(8):
            talk.load(0.1 * k, -30.0 + k, 10.0)
            talk.sync(4)
            if k in (3, 5):
                assert talk.put("H", 0x2200, 1, k) == 0  # saturated, then drifting
                talk.sync(3, 1700)
                assert talk.put("H", 0x2200, 1, 0) == 0
        talk.sleep(90_000)
        talk.sync(1)
        talk.upload(0x6130, 1)
        assert talk.put("I", 0x1010, 3, codes.SIGNATURE_SAVE) == 0
        second = Talk(f"filter {kind}, {constant}, power cycle", store=talk.recorded.stored())
        assert second.get("B", 0x61A0, 2) == kind
        second.start()
        second.sync(5)
        found += [talk.recording, second.recording]
    return found


def front_ends() -> list[Recording]:
    """24 bits behind a quarter bridge that warms up, and 16 bits behind an amplifier of its own."""
    found = []
    for named in (
        {"bridge": "quarter", "bits": 24, "temperature": [[0, 20], [0.0625, 40]], "apparent_strain": 1.5},
        {"bridge": "half", "gain": 128, "temperature": 30, "gain_drift_ppm": 64},
    ):
        talk = Talk(f"front end {named['bridge']}", front_end=named)
        talk.calibrate()
        talk.start()
        for k in range(20):
            talk.load(0.5 * k, -30.0 + 3.0 * k, 10.0)
            talk.sync(2)
            for index in (0x6100, 0x7100, 0x9100, 0x6122, 0x2122):
                talk.upload(index, 0 if index == 0x2122 else 1)
        found.append(talk.recording)
    return found


SCRIPTS: tuple[Callable[[], list[Recording]], ...] = (
    nmt_and_sdo, calibration, measurement, pdos, network, lss, eds, many_gauges, judged, filters,
    front_ends,
)  # fmt: skip
