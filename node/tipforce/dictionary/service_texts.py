"""Texts of the CANopen services: SDO abort codes, EMCY error codes, NMT states, LSS services (CiA 301, CiA 305)."""

from typing import Final

from canopen_device.core import codes, emcy
from tipforce.dictionary import table

EMCY_CODES: Final = {
    emcy.NO_ERROR: "no error", table.EMCY_TEMPERATURE: "temperature", table.EMCY_GAUGE_SATURATED: "gauge saturated",
    table.EMCY_OVERLOAD: "overload", table.EMCY_FRONT_END: "front end",
    table.EMCY_CALIBRATION_INVALID: "stored calibration invalid", emcy.CAN_OVERRUN: "CAN overrun",
    emcy.ERROR_PASSIVE: "CAN error passive", emcy.HEARTBEAT_LOST: "heartbeat lost",
    emcy.BUS_OFF_RECOVERED: "recovered from bus-off", emcy.COB_ID_COLLISION: "COB-ID collision",
    emcy.PDO_LENGTH: "PDO length", emcy.SYNC_LENGTH: "SYNC length", emcy.RPDO_TIMEOUT: "RPDO timeout",
    emcy.WEAR_BUDGET_EMPTY: "too many stores or erases",
}  # fmt: skip
NMT_STATES: Final = {
    codes.INITIALISING: "boot-up", codes.STOPPED: "stopped", codes.OPERATIONAL: "operational",
    codes.PRE_OPERATIONAL: "pre-operational",
}  # fmt: skip
NMT_COMMANDS: Final = {
    codes.NMT_START: "start", codes.NMT_STOP: "stop", codes.NMT_ENTER_PRE_OPERATIONAL: "enter pre-operational",
    codes.NMT_RESET_NODE: "reset node", codes.NMT_RESET_COMMUNICATION: "reset communication",
}  # fmt: skip
_ABORTS: Final = {
    codes.TOGGLE: "toggle bit not alternated", codes.TIMEOUT: "SDO protocol timed out",
    codes.UNKNOWN_COMMAND: "unknown command specifier", codes.BLOCK_SIZE: "invalid block size",
    codes.BLOCK_SEQUENCE: "invalid sequence number", codes.BLOCK_CRC: "CRC error", codes.OUT_OF_MEMORY: "out of memory",
    0x06010000: "unsupported access", codes.WRITE_ONLY: "object is write-only", codes.READ_ONLY: "object is read-only",
    codes.NO_OBJECT: "object does not exist", codes.NOT_MAPPABLE: "object cannot be mapped into a PDO",
    codes.PDO_LENGTH: "mapped objects exceed the PDO length", codes.INCOMPATIBLE: "parameters are incompatible",
    0x06040047: "internal incompatibility in the device", codes.HARDWARE: "hardware error",
    codes.LENGTH: "wrong length for the data type", codes.TOO_LONG: "too long for the data type",
    codes.TOO_SHORT: "too short for the data type", codes.NO_SUB: "sub-index does not exist",
    codes.INVALID_VALUE: "invalid value", codes.TOO_HIGH: "value too high", codes.TOO_LOW: "value too low",
    0x06090036: "maximum is below minimum", 0x060A0023: "resource not available", codes.GENERAL: "general error",
    codes.NOT_TRANSFERRED: "data cannot be transferred or stored",
    0x08000021: "refused: the device is under local control", codes.DEVICE_STATE: "refused in the present device state",
    0x08000023: "no object dictionary is present", codes.NO_DATA: "no data available",
}  # fmt: skip
_EMCY_CLASSES: Final = {
    0x10: "generic error", 0x20: "current", 0x21: "current, device input", 0x22: "current inside the device",
    0x23: "current, device output", 0x30: "voltage", 0x31: "mains voltage", 0x32: "voltage inside the device",
    0x33: "output voltage", 0x40: "temperature", 0x41: "ambient temperature", 0x42: "device temperature",
    0x50: "device hardware", 0x60: "device software", 0x61: "internal software", 0x62: "user software",
    0x63: "data set", 0x70: "additional modules", 0x80: "monitoring", 0x81: "communication", 0x82: "protocol error",
    0x90: "external error", 0xF0: "additional functions", 0xFF: "device-specific",
}  # fmt: skip
"""By the high byte of the code (CiA 301, table 26), for codes that no fingertip sends."""
LSS_SERVICES: Final = {
    codes.LSS_SWITCH_GLOBAL: "switch all nodes to", codes.LSS_NODE_ID: "configure node-id",
    codes.LSS_BIT_TIMING: "configure bit rate", codes.LSS_ACTIVATE: "activate bit rate", codes.LSS_STORE: "store",
    codes.LSS_SELECTED: "selected", codes.LSS_IDENTIFIED: "identified",
    codes.LSS_IDENTIFY_UNCONFIGURED: "identify unconfigured nodes",
    codes.LSS_UNCONFIGURED_RESPONSE: "unconfigured node present", codes.LSS_FASTSCAN: "fastscan",
    codes.LSS_INQUIRE_NODE_ID: "inquire node-id",
}  # fmt: skip
LSS_PARTS: Final = ("vendor", "product", "revision", "serial")


def abort_text(code: int) -> str:
    """Return the meaning of an SDO abort code."""
    return _ABORTS.get(code, "abort code without a standard meaning")


def emcy_text(code: int, register: int) -> str:
    """Return an EMCY as text: its code, the meaning, and the error register (object 1001h)."""
    if code >> 8 == 0:
        return f"{EMCY_CODES[0]}, error register 0x{register:02X}"
    meaning = EMCY_CODES.get(code) or _EMCY_CLASSES.get(code >> 8) or _EMCY_CLASSES.get(code >> 12 << 4, "error")
    return f"0x{code:04X} {meaning}, error register 0x{register:02X}"


def state_text(state: int) -> str:
    """Return the name of an NMT state."""
    return NMT_STATES.get(state, f"state {state}")
