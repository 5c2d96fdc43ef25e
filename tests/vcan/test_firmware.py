"""A program of 64 kB over vcan0, with progress."""

import can

from microcontroller import program_board
from microcontroller.program_board import NODE_ID, Board, image
from tipforce.host.network.bus import Bus
from tipforce.host.network.firmware import Firmware, install
from tipforce_loader.image import Header


def test_64_kb_with_progress() -> None:
    content = image(size=64 * 1024)
    firmware = Firmware(content, Header(content))
    board, arrived = Board(), list[int]()
    with (
        can.Bus(interface="socketcan", channel="vcan0") as end,
        program_board.running(board, end),
        Bus(can.Bus(interface="socketcan", channel="vcan0"), timeout_s=10.0) as bus,
    ):
        after = install(bus, NODE_ID, firmware, progress=arrived.append)
    assert (after.version, after.identification) == ("0.2.0", firmware.header.crc)
    assert bytes(board.flash.programs[0]) == firmware.content
    # 127 segments of 7 bytes are one block.
    assert len(arrived) >= len(firmware.content) / 889
    assert arrived == sorted(arrived)
    assert arrived[-1] == len(firmware.content)
