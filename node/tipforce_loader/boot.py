"""Start the program that the loader chooses."""

import sys

from . import board
from .flash import FileSlots, FlashStore
from .programs import INSTALLED, FileProgramSlots, Programs

programs: "Programs | None" = None  # None: the board has no key, and no slots
_MOUNT = "/running"


def run() -> None:
    """Import the main program, ``board.MAIN``, from a slot or from the file system; it runs until power-off."""
    global programs  # noqa: PLW0603 (the program that is imported finds it here)
    if board.PROGRAM_KEY:
        store = FlashStore(FileSlots(board.PROGRAM_FOLDER + "-record"))
        slots = FileProgramSlots(board.PROGRAM_FOLDER)
        programs = Programs(slots, store, board.PROGRAM_KEY, board.PRODUCT, board.VERSION)
        slot = programs.choose()
    try:
        if board.PROGRAM_KEY and slot != INSTALLED:
            import vfs

            from .image import ImageFiles

            vfs.mount(ImageFiles(lambda: slots.open(slot, "rb")), _MOUNT)
            sys.path.insert(0, _MOUNT)
        __import__(board.MAIN)
    except Exception as error:
        if programs is None or not programs.on_trial:
            raise
        sys.print_exception(error)  # type: ignore[attr-defined]
        board.restart()  # which returns to the program before
