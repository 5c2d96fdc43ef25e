"""The CRC of SDO block transfer (CiA 301, 7.2.4.3.16): polynomial x^16 + x^12 + x^5 + 1, start value 0."""

_NIBBLE = (
    0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5, 0x60C6, 0x70E7,
    0x8108, 0x9129, 0xA14A, 0xB16B, 0xC18C, 0xD1AD, 0xE1CE, 0xF1EF,
)  # fmt: skip


def crc16_by_nibbles(data: "bytes | bytearray", crc: int = 0) -> int:
    """Continue ``crc`` over ``data``. The table has 16 entries instead of 256 to save memory on a microcontroller."""
    for byte in data:
        crc = (crc << 4 & 0xFFFF) ^ _NIBBLE[crc >> 12 ^ byte >> 4]
        crc = (crc << 4 & 0xFFFF) ^ _NIBBLE[crc >> 12 ^ byte & 15]
    return crc


try:
    from binascii import crc_hqx
except ImportError:  # MicroPython has no binascii.crc_hqx
    crc_hqx = None  # type: ignore[assignment]


def crc16(data: "bytes | bytearray", crc: int = 0) -> int:
    """Continue ``crc`` over ``data``, with the interpreter's function if it has one."""
    return crc_hqx(data, crc) if crc_hqx is not None else crc16_by_nibbles(data, crc)
