"""pcap and pcapng of SocketCAN: written here by hand, and by Wireshark's text2pcap and editcap where they are."""

import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.host.logs.reader import open_log

FRAMES = [
    (0x00000285, bytes(range(8))), (0x81234567, b"\x07"), (0x40000181, b""), (0x20000004, b"\0\4\0\0\0\0\0\0"),
]  # fmt: skip
T_NS = 1_700_000_000_123_456_000
COUNTS = {"remote frame": 1, "error frame": 1}


def socketcan(can_id: int, data: bytes, flags: int = 0) -> bytes:
    return struct.pack(">IBBxx", can_id, len(data), flags) + data


def cooked(can_id: int, data: bytes, protocol: int = 0x000C) -> bytes:
    return struct.pack(">HHHQH", 0, 280, 0, 0, protocol) + socketcan(can_id, data)


def cooked_2(can_id: int, data: bytes, index: int = 3) -> bytes:
    return struct.pack(">HHIHBBQ", 0x000C, 0, index, 280, 0, 0, 0) + socketcan(can_id, data)


def pcap(packets: list[bytes], link: int = 227, order: str = "<", magic: int = 0xA1B2C3D4) -> bytes:
    unit = 1000 if magic == 0xA1B2C3D4 else 1
    text = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for number, packet in enumerate(packets):
        t_ns = T_NS + number * 1_000_000
        stamp = (t_ns // 1_000_000_000, t_ns % 1_000_000_000 // unit)
        text += struct.pack(f"{order}IIII", *stamp, len(packet), len(packet)) + packet
    return text


def block(kind: int, body: bytes, order: str) -> bytes:
    body += bytes(-len(body) % 4)
    length = struct.pack(f"{order}I", len(body) + 12)
    return struct.pack(f"{order}I", kind) + length + body + length


def pcapng(
    packets: list[bytes], order: str = "<", link: int = 227, resolution: int = 9, offset_s: int = 0, kind: int = 6
) -> bytes:  # fmt: skip
    text = block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1), order)
    options = struct.pack(f"{order}HH4sHHB3xHHqHH", 2, 4, b"can7", 9, 1, resolution, 14, 8, offset_s, 0, 0)
    text += block(1, struct.pack(f"{order}HHI", link, 0, 0) + options, order)
    text += block(4, b"names of hosts, which nobody asked for", order)
    for number, packet in enumerate(packets):
        ticks = (T_NS - offset_s * 10**9 + number * 1_000_000) // 10 ** (9 - resolution)
        of_interface = struct.pack(f"{order}I" if kind == 6 else f"{order}HH", *(0, 7)[: 1 + (kind == 2)])
        head = struct.pack(f"{order}IIII", ticks >> 32, ticks & 0xFFFFFFFF, len(packet), len(packet))
        text += block(kind, of_interface + head + packet, order)
    return text


def check(path: Path, channel: str) -> None:
    with open_log(path, strict=True) as log:
        frames = np.concatenate(list(log))
    assert frames["can_id"].tolist() == [can_id for can_id, _ in FRAMES]
    assert [row["data"].tobytes()[: row["length"]] for row in frames] == [data for _, data in FRAMES]
    assert frames["t_ns"].tolist() == [T_NS + k * 1_000_000 for k in range(len(FRAMES))]
    assert (log.channels, log.skipped) == ([channel], COUNTS)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("magic", "resolution"), [(0xA1B2C3D4, 6), (0xA1B23C4D, 9)])
def test_both_formats(tmp_path: Path, order: str, magic: int, resolution: int) -> None:
    path, packets = tmp_path / "x", [socketcan(*frame) for frame in FRAMES]
    path.write_bytes(pcap(packets, order=order, magic=magic))
    check(path, "can")
    path.write_bytes(pcapng(packets, order, resolution=resolution))
    check(path, "can7")
    path.write_bytes(pcapng(packets, order, offset_s=1_699_999_000, kind=2))
    check(path, "can7")


def test_cooked_captures(tmp_path: Path) -> None:
    path = tmp_path / "x.log"  # the first bytes decide, not the name
    path.write_bytes(pcap([cooked(*frame) for frame in FRAMES], link=113))
    check(path, "can")
    path.write_bytes(pcap([cooked_2(*frame) for frame in FRAMES], link=276))
    check(path, "if3")


def test_frames_of_several_interfaces_stay_apart(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(pcap([cooked_2(0x185, b"", index) for index in (3, 4, 3)], link=276))
    with open_log(path, strict=True) as log:
        assert (np.concatenate(list(log))["channel"].tolist(), log.channels) == ([0, 1, 0], ["if3", "if4"])
    text = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1), "<")
    text += 2 * block(1, struct.pack("<HHI", 227, 0, 0), "<")  # without names
    for number in (1, 0):
        text += block(6, struct.pack("<IIIII", number, 0, 0, 8, 8) + socketcan(0x185, b""), "<")
    path.write_bytes(text)
    with open_log(path, strict=True) as log:
        assert (np.concatenate(list(log))["channel"].tolist(), log.channels) == ([1, 0], ["can", "if1"])


def counted(path: Path, content: bytes) -> tuple[int, dict[str, int], dict[str, int]]:
    """The number of frames in a file with this content, and what was skipped and what was bad in it."""
    path.write_bytes(content)
    with open_log(path) as log:
        return sum(len(frames) for frames in log), log.skipped, log.bad


def test_what_is_no_classic_frame_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "x.pcap"
    fd = socketcan(0x123, bytes(12), flags=4)
    content = pcap([fd, socketcan(0x181, b"\x01"), b"short", socketcan(0x181, bytes(9))])
    assert counted(path, content) == (1, {"CAN FD frame": 1}, {"not CAN": 2})
    with open_log(path) as log:
        (frame,) = next(log.blocks()).fd
    assert (frame.row, frame.can_id, frame.flags, frame.data) == (0, 0x123, 0, bytes(12))
    content = pcap([socketcan(0x285, bytes(8))[:12], socketcan(0x285, bytes(8))])  # one cut by the snap length
    assert counted(path, content) == (1, {}, {"not CAN": 1})
    content = pcap([cooked(0x123, bytes(12), 0x000D), cooked(0x181, b"", 0x0800)], link=113)
    assert counted(path, content) == (0, {"CAN FD frame": 1}, {"not CAN": 1})
    path.write_bytes(pcap([bytes(60)], link=1))
    with open_log(path, strict=True) as log, pytest.raises(InputError, match=r"not a CAN frame \(link type 1\)"):
        list(log)


def test_a_cut_file_gives_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "x"
    for text in (pcap([socketcan(*frame) for frame in FRAMES]), pcapng([socketcan(*frame) for frame in FRAMES])):
        assert counted(path, text[:-3])[::2] == (3, {"unreadable": 1})


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_broken_bytes_are_no_traceback(tmp_path: Path, data: st.DataObject) -> None:
    packets = [socketcan(*frame) for frame in FRAMES]
    text = bytearray(data.draw(st.sampled_from([pcap(packets), pcapng(packets)])))
    for _ in range(data.draw(st.integers(1, 4))):
        text[data.draw(st.integers(4, len(text) - 1))] = data.draw(st.integers(0, 255))
    assert counted(tmp_path / "x", bytes(text))[0] <= len(FRAMES)


@pytest.mark.skipif(not shutil.which("text2pcap"), reason="needs Wireshark's text2pcap and editcap")
def test_what_wireshark_writes(tmp_path: Path) -> None:
    hexdump = "".join(f"0000  {socketcan(*frame).hex(' ')}\n" for frame in FRAMES)
    source, path = tmp_path / "x.txt", tmp_path / "x.pcap"
    source.write_text(hexdump)
    for command in (
        ["text2pcap", "-q", "-l", "227", str(source), str(path)],
        ["editcap", "-F", "pcapng", str(path), str(tmp_path / "x.pcapng")],
    ):
        subprocess.run(command, check=True, capture_output=True)
    for name in ("x.pcap", "x.pcapng"):
        with open_log(tmp_path / name, strict=True) as log:
            frames = np.concatenate(list(log))
        assert frames["can_id"].tolist() == [can_id for can_id, _ in FRAMES]
