"""The communication area of the dictionary of a fingertip node, CiA 301: 1000h to 1FFFh."""

from tipforce.device import codes, communication
from tipforce.dictionary.table import (
    ADD_NODE_ID,
    ARRAY,
    COUNTED,
    DOMAIN,
    MAX_MAPPED,
    NOT_STORED,
    RECORD,
    REVISION,
    RPDO,
    SOFTWARE_VERSION,
    STRING,
    TPDO,
    U8,
    U16,
    U32,
    array,
    mapped_bits,
    record,
    var,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from tipforce.dictionary.table import Object, Pdo

# A table: one entry a line says more than one argument a line.
# fmt: off


def communication_area(product: int, simulated: bool) -> "tuple[Object, ...]":
    """Objects 1000h to 1FFFh but the PDOs and programs (CiA 301)."""
    stores = ("all parameters", "communication parameters", "application parameters", "calibration")
    return (
        var(communication.DEVICE_TYPE, "Device type", "device_type", U32, "ro", 0, 0x00020194),
        var(communication.ERROR_REGISTER, "Error register", "error_register", U8, "ro", TPDO),
        var(communication.MANUFACTURER_STATUS, "Manufacturer status register", "manufacturer_status", U32, "ro", TPDO),
        (
            communication.ERROR_HISTORY,
            ARRAY,
            "Pre-defined error field",
            "error_history",
            (
                (0, 1, "Number of errors", "error_history.count", U8, "rw", NOT_STORED, 0, None, None, ""),
                (1, 8, "Error %d", "error_history", U32, "ro", 0, 0, None, None, ""),
            ),
        ),
        var(communication.COB_ID_SYNC, "COB-ID SYNC", "sync.cob_id", U32, "rw", COUNTED, codes.SYNC_COB_ID),
        var(communication.SYNC_WINDOW, "Synchronous window length", "sync.window_us", U32, "rw", 0, 0, unit="us"),
        var(
            communication.DEVICE_NAME, "Manufacturer device name", "device_name", STRING, "const", 0,
            "tipforce fingertip",
        ),
        var(
            communication.HARDWARE_VERSION, "Manufacturer hardware version", "hardware_version", STRING, "const", 0,
            "simulated" if simulated else "1",
        ),
        var(
            communication.SOFTWARE_VERSION, "Manufacturer software version", "software_version", STRING,
            "const", 0, SOFTWARE_VERSION,
        ),
        var(communication.GUARD_TIME, "Guard time", "node_guarding.guard_time_ms", U16, "rw", unit="ms"),
        var(communication.LIFE_TIME_FACTOR, "Life time factor", "node_guarding.life_time_factor", U8, "rw"),
        array(
            communication.STORE_PARAMETERS, "Store parameters", "store", 4, tuple("Save " + s for s in stores),
            U32, "rw", NOT_STORED, 1,
        ),
        array(
            communication.RESTORE_DEFAULTS, "Restore default parameters", "restore", 4,
            tuple("Restore " + s for s in stores),
            U32, "rw", NOT_STORED, 1,
        ),
        var(
            communication.COB_ID_TIME, "COB-ID time stamp object", "time.cob_id", U32, "rw", 0,
            codes.TIME_CONSUMER | codes.TIME_COB_ID,
        ),
        var(
            communication.HIGH_RESOLUTION_TIME, "High resolution time stamp", "time.high_resolution_us",
            U32, "rw", TPDO | RPDO | NOT_STORED, unit="us",
        ),
        var(
            communication.COB_ID_EMCY, "COB-ID EMCY", "emcy.cob_id", U32, "rw", ADD_NODE_ID | COUNTED, codes.EMCY_BASE,
        ),
        var(communication.EMCY_INHIBIT_TIME, "Inhibit time EMCY", "emcy.inhibit_100us", U16, "rw", unit="100 us"),
        array(
            communication.CONSUMER_HEARTBEAT, "Consumer heartbeat time", "heartbeat.consumer", 4,
            "Consumer heartbeat time %d",
            U32, "rw",
        ),
        var(
            communication.PRODUCER_HEARTBEAT, "Producer heartbeat time", "heartbeat.producer_ms", U16, "rw", COUNTED,
            1000, unit="ms",
        ),
        record(
            communication.IDENTITY, "Identity object", "identity",
            (1, "Vendor-ID", "vendor", U32, "ro"),
            (2, "Product code", "product", U32, "ro", 0, product),
            (3, "Revision number", "revision", U32, "ro", 0, REVISION),
            (4, "Serial number", "serial", U32, "ro"),
        ),
        var(
            communication.SYNC_OVERFLOW, "Synchronous counter overflow value", "sync.counter_overflow", U8, "rw",
            COUNTED, 0, 0, 240,
        ),
        record(
            communication.VERIFY_CONFIGURATION, "Verify configuration", "verify_configuration",
            (1, "Configuration date", "date", U32, "rw"),
            (2, "Configuration time", "time", U32, "rw"),
        ),
        var(communication.STORED_EDS, "Store EDS", "eds", DOMAIN, "ro"),
        var(communication.EDS_FORMAT, "Store format", "eds_format", U16, "ro"),
        array(
            communication.ERROR_BEHAVIOUR, "Error behaviour", "error_behaviour", 1, "Communication error",
            U8, "rw", 0, 0, 0, 2,
        ),
        record(
            communication.SDO_SERVER, "SDO server parameter", "sdo_server",
            (1, "COB-ID client to server", "client_to_server", U32, "ro", ADD_NODE_ID, codes.SDO_REQUEST_BASE),
            (2, "COB-ID server to client", "server_to_client", U32, "ro", ADD_NODE_ID, codes.SDO_RESPONSE_BASE),
        ),
        var(communication.NMT_STARTUP, "NMT startup", "nmt_startup", U32, "rw", 0, 4),
    )


def pdo_objects(direction: str, first: int, pdo: "Pdo") -> "tuple[Object, Object]":
    """Communication and mapping parameters of a PDO."""
    number, message, base, enabled, transmission, event_ms, mapped = pdo
    slug = "%s%d" % (direction, number)
    title = "%s%d %s" % (direction.upper(), number, message.lower())
    counted = COUNTED if direction == "tpdo" else 0
    cob_id = base | (codes.NO_RTR if direction == "tpdo" else 0) | (0 if enabled else codes.COB_ID_INVALID)
    entries: list[tuple[Any, ...]] = [
        (1, "COB-ID", "cob_id", U32, "rw", counted | (ADD_NODE_ID if base else 0), cob_id),
        (2, "Transmission type", "transmission_type", U8, "rw", counted, transmission),
    ]
    if direction == "tpdo":
        entries.append((3, "Inhibit time", "inhibit_100us", U16, "rw", counted, 0, None, None, "100 us"))
    entries.append((5, "Event timer", "event_timer_ms", U16, "rw", counted, event_ms, None, None, "ms"))
    if direction == "tpdo":
        entries.append((6, "SYNC start value", "sync_start", U8, "rw", counted, 0, 0, 240))
    bits = tuple(index << 16 | sub << 8 | mapped_bits(index) for index, sub in mapped)
    slots = bits + (0,) * (MAX_MAPPED - len(bits))
    return (
        record(first + number - 1, title + " communication", slug, *entries),
        (
            first + communication.MAPPING + number - 1,
            RECORD,
            title + " mapping",
            slug + ".mapping",
            (
                (0, 1, "Number of mapped objects", slug + ".mapped",
                 U8, "rw", counted, len(bits), 0, MAX_MAPPED, ""),
                (1, MAX_MAPPED, "Mapped object %d", slug + ".mapping",
                 U32, "rw", counted, slots, None, None, ""),
            ),
        ),
    )


def programs() -> "tuple[Object, ...]":
    """CiA 302-3; the values of 1F51h and 1F57h are in ``tipforce.device.program``."""
    return (
        array(communication.PROGRAM_DATA, "Program data", "program.data", 1, "Program number %d", DOMAIN, "wo"),
        array(
            communication.PROGRAM_CONTROL, "Program control", "program.control", 1, "Program number %d",
            U8, "rw", NOT_STORED, 1, 0, 3,
        ),
        array(
            communication.PROGRAM_IDENTIFICATION, "Program software identification", "program.identification", 1,
            "Program number %d", U32, "ro",
        ),
        array(communication.FLASH_STATUS, "Flash status", "program.flash_status", 1, "Program number %d", U32, "ro"),
    )
