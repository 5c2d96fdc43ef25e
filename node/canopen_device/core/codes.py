"""Numbers that CiA 301 and CiA 305 fix for any device, declared only here: COB-IDs, states, abort codes, flags. Module
``communication`` declares the indices of the communication area, ``emcy`` the EMCY error codes."""

# COB-IDs of the services (7.3.5, tables 39 and 40); the node-id is added to a base.
NMT_COB_ID, SYNC_COB_ID, TIME_COB_ID = 0x000, 0x080, 0x100
EMCY_BASE, HEARTBEAT_BASE = 0x080, 0x700  # node guarding and the boot-up message use the heartbeat's base
TPDO_BASES, RPDO_BASES = (0x180, 0x280, 0x380, 0x480), (0x200, 0x300, 0x400, 0x500)
LAST_SYNCHRONOUS = 240  # the highest synchronous transmission type of a PDO, and SYNC counter
EVENT_DRIVEN = 254  # the lowest event-driven one; those between are reserved, or sent on RTR
SDO_RESPONSE_BASE, SDO_REQUEST_BASE = 0x580, 0x600  # server to client, client to server
LSS_RESPONSE_COB_ID, LSS_REQUEST_COB_ID = 0x7E4, 0x7E5  # CiA 305
FUNCTION_MASK, NODE_ID_MASK = 0x780, 0x07F

# LSS command specifiers (CiA 305). A range follows the order of the identity's parts in 1018h.
LSS_SWITCH_GLOBAL, LSS_NODE_ID, LSS_BIT_TIMING, LSS_ACTIVATE, LSS_STORE = 0x04, 0x11, 0x13, 0x15, 0x17
LSS_SELECT_FIRST, LSS_SELECT_LAST, LSS_SELECTED = 0x40, 0x43, 0x44
LSS_IDENTIFY_FIRST, LSS_IDENTIFY_LAST, LSS_IDENTIFIED = 0x46, 0x4B, 0x4F
LSS_IDENTIFY_UNCONFIGURED, LSS_UNCONFIGURED_RESPONSE, LSS_FASTSCAN = 0x4C, 0x50, 0x51
LSS_INQUIRE_FIRST, LSS_INQUIRE_NODE_ID = 0x5A, 0x5E
LSS_START_FASTSCAN = 0x80  # bit number with which every device starts
LSS_UNCONFIGURED = 255  # a node-id

# NMT commands (7.2.8.3.1) and states as the heartbeat encodes them (7.2.8.3.2); the boot-up message is state 0.
NMT_START, NMT_STOP, NMT_ENTER_PRE_OPERATIONAL, NMT_RESET_NODE, NMT_RESET_COMMUNICATION = 1, 2, 128, 129, 130
INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
TALKING = (PRE_OPERATIONAL, OPERATIONAL)  # the states in which a device serves SDO, SYNC, TIME and EMCY

# Signatures of 1010h and 1011h: "save", "load".
SIGNATURE_SAVE, SIGNATURE_LOAD = 0x65766173, 0x64616F6C

# SDO abort codes (7.2.4.3.17).
TOGGLE, TIMEOUT, UNKNOWN_COMMAND = 0x05030000, 0x05040000, 0x05040001
BLOCK_SIZE, BLOCK_SEQUENCE, BLOCK_CRC, OUT_OF_MEMORY = 0x05040002, 0x05040003, 0x05040004, 0x05040005
WRITE_ONLY, READ_ONLY, NO_OBJECT = 0x06010001, 0x06010002, 0x06020000
NOT_MAPPABLE, PDO_LENGTH, INCOMPATIBLE, HARDWARE = 0x06040041, 0x06040042, 0x06040043, 0x06060000
LENGTH, TOO_LONG, TOO_SHORT, NO_SUB = 0x06070010, 0x06070012, 0x06070013, 0x06090011
INVALID_VALUE, TOO_HIGH, TOO_LOW, GENERAL = 0x06090030, 0x06090031, 0x06090032, 0x08000000
NOT_TRANSFERRED, DEVICE_STATE, NO_DATA = 0x08000020, 0x08000022, 0x08000024

# Identifier flags and masks of SocketCAN's can_id, the format of frames in ``step``.
EXTENDED_FLAG, REMOTE_FLAG, ERROR_FLAG = 0x80000000, 0x40000000, 0x20000000
STANDARD_MASK, EXTENDED_MASK = 0x7FF, 0x1FFFFFFF

# Flags of COB-ID objects (7.5.2.35): bit 31: the object is not valid; bit 30 of a TPDO: no remote request;
# bit 29: 29-bit identifier, which this device does not support.
COB_ID_INVALID, NO_RTR, COB_ID_RESERVED = 0x80000000, 0x40000000, 0x7FFFF800
EXTENDED_COB_ID = 0x20000000
SYNC_PRODUCER = 0x40000000  # of 1005h: bit 30, the device sends SYNC
TIME_CONSUMER = 0x80000000  # of 1012h: bit 31, the device consumes TIME


def restricted(can_id: int) -> bool:
    """Return True for an identifier that no configurable object may have (7.3.5, table 41)."""
    return (
        can_id <= 0x7F or 0x101 <= can_id <= 0x180 or 0x581 <= can_id <= 0x5FF or 0x601 <= can_id <= 0x67F
        or 0x6E0 <= can_id <= 0x6FF or can_id >= 0x701
    )  # fmt: skip


# A due time that never occurs: later than any clock in microseconds, and exact as a float.
NEVER_US = 1 << 62
