"""Main program for a microcontroller with a CAN controller: ``board.MAIN`` names it."""

from firmware import app
from tipforce_loader import board

try:
    from machine import CAN
except ImportError:
    from pyb import CAN  # MicroPython up to 1.27

    from firmware.can_pyb import PybCan

    app.start(PybCan(CAN(board.CAN_NUMBER), board.BIT_RATE))
else:
    from firmware.can_machine import MachineCan

    app.start(MachineCan(CAN(board.CAN_NUMBER, board.BIT_RATE), board.BIT_RATE))
