"""Numbers of CiA 301 that several services need: NMT states, SDO abort codes, SocketCAN identifier flags."""

# NMT states as the heartbeat carries them (7.3.2.2).
INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127

# SDO abort codes (7.2.4.3.17).
TOGGLE = 0x05030000
TIMEOUT = 0x05040000
UNKNOWN_COMMAND = 0x05040001
BLOCK_SIZE = 0x05040002
BLOCK_SEQUENCE = 0x05040003
BLOCK_CRC = 0x05040004
UNSUPPORTED_ACCESS = 0x06010000
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_LENGTH = 0x06040042
INCOMPATIBLE = 0x06040043
HARDWARE = 0x06060000
LENGTH = 0x06070010
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUB = 0x06090011
INVALID_VALUE = 0x06090030
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032
NOT_TRANSFERRED = 0x08000020
DEVICE_STATE = 0x08000022
NO_DATA = 0x08000024

# Identifier flags and mask of SocketCAN's can_id, in which frames go in and out.
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x80000000, 0x40000000, 0x20000000
STANDARD_MASK = 0x7FF

# COB-ID objects: bit 31, the object does not exist; bit 29 and those of a 29-bit identifier, which is not offered.
COB_ID_INVALID, COB_ID_RESERVED = 0x80000000, 0x7FFFF800


def restricted(can_id: int) -> bool:
    """True for an identifier that no configurable object may have (7.3.5, table 41)."""
    return (
        can_id <= 0x7F
        or 0x101 <= can_id <= 0x180
        or 0x581 <= can_id <= 0x5FF
        or 0x601 <= can_id <= 0x67F
        or 0x6E0 <= can_id <= 0x6FF
        or can_id >= 0x701
    )


# A due time that never comes: later than any clock of microseconds, exact in a float as well.
NEVER_US = 1 << 62
