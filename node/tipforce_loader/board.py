"""Settings of one board: change this file, and none of the others. The example is an ESP32 with two NAU7802 (three
gauges, two of them on the first chip) and an MCP2515; if the microcontroller has its own controller, ``can_number``
selects it and the MCP2515's pins are not used."""

NODE_ID = 5  # 1 to 127; 255 waits for LSS
BIT_RATE = 1000000

CAN_NUMBER = 1  # main.py: of machine.CAN or pyb.CAN
MCP2515_SPI, MCP2515_CS, MCP2515_HZ = 1, 5, 16000000  # main_mcp2515.py: SPI bus, pin, crystal

# Counts of the converter per microstrain: gauge factor 2, quarter bridge, gain 128 and a ratiometric reference with
# the range of +-0.5 AVDD / gain give 2 * 0.25e-6 * 128 * 2**24 = 1073.7. A calibration on the node replaces it.
COUNTS_PER_MICROSTRAIN = 1073.741824

FOLDER = "/tip"  # for the two slots
WATCHDOG_MS = 2000  # 0: none

MAIN = "firmware.main"  # firmware.main_mcp2515 with that controller
# Programs over the bus (1F50h): 1 to 64 secret bytes that the host does not send. Empty: none, and no such objects.
PROGRAM_KEY = b""
PROGRAM_FOLDER = "/program"  # for the two slots
PRODUCT, VERSION = 0x54500000, "0.1.0"  # 1018h:2 without gauges and options; version of the program copied to the board


def chips():  # type: ignore[no-untyped-def]
    """Return the converters, in the order of the gauges."""
    from machine import I2C, Pin

    from firmware.nau7802 import Nau7802

    first = I2C(0, scl=Pin(22), sda=Pin(21), freq=400000)
    second = I2C(1, scl=Pin(19), sda=Pin(18), freq=400000)
    return [Nau7802(first, channels=2), Nau7802(second)]


def restart() -> None:
    """Restart the microcontroller."""
    import machine

    machine.reset()


def serial() -> int:
    """Return 1018h:4, from the microcontroller's unique number."""
    import binascii

    import machine

    return binascii.crc32(machine.unique_id()) & 0xFFFFFFFF
