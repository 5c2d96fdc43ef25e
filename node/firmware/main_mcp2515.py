"""Main program for an MCP2515 on SPI: ``board.MAIN`` names it."""

from machine import SPI, Pin

from firmware import app
from firmware.can_mcp2515 import Mcp2515
from tipforce_loader import board

_SPI = SPI(board.MCP2515_SPI, baudrate=8000000, polarity=0, phase=0)
app.start(Mcp2515(_SPI, Pin(board.MCP2515_CS, Pin.OUT, value=1), board.BIT_RATE, board.MCP2515_HZ))
