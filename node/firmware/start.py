"""From the settings in board.py to a running node: what both main programs do."""

from . import board
from .app import Clock, Firmware
from .flash import FileSlots, FlashStore
from .source import Gauges

TYPE_CHECKING = False
if TYPE_CHECKING:
    from .can_port import CanPort


def node(port: "CanPort") -> Firmware:
    """The node on this board with this controller."""
    gauges = Gauges(board.chips(), board.COUNTS_PER_MICROSTRAIN)  # type: ignore[no-untyped-call]
    return Firmware(board.NODE_ID, gauges, port, FlashStore(FileSlots(board.FOLDER)), board.serial(), Clock())


def run(port: "CanPort") -> None:
    """Be that node until power goes, under the watchdog where one is wanted."""
    firmware = node(port)
    if not board.WATCHDOG_MS:
        firmware.run()
    from machine import WDT

    firmware.run(feed=WDT(timeout=board.WATCHDOG_MS).feed)
