"""Start a node from the settings in board.py: the common part of both main programs."""

import machine  # type: ignore[import-not-found]

from tipforce_loader import board, boot
from tipforce_loader.flash import FileSlots, FlashStore

from .app import Clock, Firmware
from .source import Gauges

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .can_port import CanPort


def node(port: "CanPort") -> Firmware:
    """Return the node on this board with this controller."""
    gauges = Gauges(board.chips(), board.COUNTS_PER_MICROSTRAIN)  # type: ignore[no-untyped-call]
    store = FlashStore(FileSlots(board.FOLDER))
    restarted = machine.reset_cause() != machine.PWRON_RESET
    return Firmware(
        board.NODE_ID, gauges, port, store, board.serial(), Clock(), boot.programs, board.restart, restarted
    )


def run(port: "CanPort") -> None:
    """Run the node until power-off, with the watchdog if it is enabled."""
    firmware = node(port)
    if not board.WATCHDOG_MS:
        firmware.run()
    from machine import WDT

    firmware.run(feed=WDT(timeout=board.WATCHDOG_MS).feed)
