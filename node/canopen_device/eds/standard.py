"""What CiA 301 fixes for the communication area (7.5.2) where a file omits or changes it; contradictions in a file."""

from canopen_device.core import codes
from canopen_device.core import communication as at
from canopen_device.core.object_dictionary import RPDO, TPDO
from canopen_device.eds import values
from canopen_device.eds.description import ARRAY, RECORD, VAR, Description, Entry, Object
from canopen_device.eds.sections import EdsFile, Section
from canopen_device.types import LETTER_OF_CODE, TYPES

_LIST = "B" + 255 * "I"
_LETTERS = {  # the types of an object's sub-indices, from 0 on
    at.DEVICE_TYPE: "I", at.ERROR_REGISTER: "B", at.MANUFACTURER_STATUS: "I", at.COB_ID_SYNC: "I",
    at.SYNC_PERIOD: "I", at.SYNC_WINDOW: "I", at.DEVICE_NAME: "s", at.HARDWARE_VERSION: "s",
    at.SOFTWARE_VERSION: "s", at.GUARD_TIME: "H", at.LIFE_TIME_FACTOR: "B", at.COB_ID_TIME: "I",
    at.HIGH_RESOLUTION_TIME: "I", at.COB_ID_EMCY: "I", at.EMCY_INHIBIT_TIME: "H", at.PRODUCER_HEARTBEAT: "H",
    at.SYNC_OVERFLOW: "B", at.STORED_EDS: "D", at.EDS_FORMAT: "H", at.NMT_STARTUP: "I", at.ERROR_HISTORY: _LIST,
    at.STORE_PARAMETERS: _LIST, at.RESTORE_DEFAULTS: _LIST, at.CONSUMER_HEARTBEAT: _LIST, at.IDENTITY: _LIST,
    at.VERIFY_CONFIGURATION: _LIST, at.ERROR_BEHAVIOUR: 256 * "B",
}  # fmt: skip
_PDO_LETTERS, _SDO_LETTERS = "BIBHBHB", "BIIB"
_MANDATORY = {  # the names of objects, and of the entries of a record
    at.DEVICE_TYPE: ["Device type"], at.ERROR_REGISTER: ["Error register"],
    at.IDENTITY: ["Identity", "Highest sub-index supported", "Vendor-ID", "Product code", "Revision number"],
}  # fmt: skip


def standard_letter(index: int, sub: int) -> str | None:
    """Return the type of an entry of the communication area, None where CiA 301 fixes none."""
    letters = _LETTERS.get(index, "")
    if at.RPDO <= index <= at.LAST_RPDO or at.TPDO <= index <= at.LAST_TPDO:
        letters = _PDO_LETTERS
    elif at.SDO_SERVER <= index <= at.SDO_SERVER | 0xFF:
        letters = _SDO_LETTERS
    elif at.is_mapping(index):
        letters = _LIST
    return letters[sub : sub + 1] or None


def add_mandatory(eds: Description) -> None:
    """Add the objects that every device has (CiA 301, 7.5.2) where the file has none, and report them."""
    for index, (name, *entry_names) in _MANDATORY.items():
        if index in eds.objects:
            continue
        made = eds.objects[index] = Object(index, name, RECORD if entry_names else VAR, 0)
        for sub, entry_name in enumerate(entry_names or [name]):
            letter, default = standard_letter(index, sub) or "B", 0 if sub else max(0, len(entry_names) - 1)
            made.entries[sub] = Entry(index, sub, entry_name, letter, "ro", default, has_default=not sub)
        value = "the numbers of [DeviceInfo]" if entry_names else "the value 0"
        eds.add(0, f"no object 0x{index:04X}, which is mandatory (CiA 301, 7.5.2); added with {value}")


# --- PDOs that an EDS only counts: CompactPDO, NrOfRXPDO and NrOfTXPDO of [DeviceInfo] (CiA 306-1) -------------

PDOS = (
    ("NrOfRXPDO", at.RPDO, at.LAST_RPDO, codes.RPDO_BASES, RPDO),
    ("NrOfTXPDO", at.TPDO, at.LAST_TPDO, codes.TPDO_BASES, TPDO),
)
# Bit k of CompactPDO: sub-index k + 1 of the communication parameter.
_PARAMETERS = (
    "COB-ID", "Transmission type", "Inhibit time", "Compatibility entry", "Event timer", "SYNC start value",
)  # fmt: skip
_ALL, _MOST = 0x3F, 512
_EVENT_DRIVEN = 255
_BITS = 64


def add_compact_pdos(file: EdsFile, eds: Description) -> None:
    """Add each PDO that is counted, but has no section; without CompactPDO report the count that differs."""
    section = file.sections.get("deviceinfo")
    if section is None:
        return
    mask = values.integer(section.get("CompactPDO") or "0").value or 0
    granularity = values.integer(section.get("Granularity") or "8").value or 8
    if not 0 <= mask <= _ALL:
        section.say("CompactPDO", f"allowed are 0x0 to 0x{_ALL:X}; read as {mask & _ALL:#x}")
        mask &= _ALL
    for key, first, last, bases, _ in PDOS:
        if not section.get(key):
            continue
        count, _, remark, _ = values.integer(section.get(key) or "")
        there = sum(first <= index <= last for index in eds.objects)
        if remark or count is None or not 0 <= count <= _MOST:
            section.say(key, remark or f"allowed are 0 to {_MOST}")
        elif mask:
            most = _BITS // granularity if 1 <= granularity <= _BITS else 8
            _add(eds, section.line, first, count, mask, bases, most)
        elif count != there:
            kind = "1400h" if first == at.RPDO else "1800h"
            section.say(key, f"the file has {there} PDOs from {kind} on; these apply")


def _add(eds: Description, line: int, first: int, count: int, mask: int, bases: tuple[int, ...], most: int) -> None:
    absent = [number for number in range(_MOST) if first + number not in eds.objects]
    missing = absent[: max(0, count - (_MOST - len(absent)))]
    for number in range(missing[-1] + 1 if missing else 0):
        index, made = first + number, []
        if number in missing:
            made.append(_parameter(eds, line, index, number, mask, bases))
        if index + at.MAPPING not in eds.objects:
            made.append(Object(index + at.MAPPING, "PDO mapping", ARRAY, line))
            for sub in range(most + 1):
                name, letter = (f"Mapped object {sub}", "I") if sub else ("Number of mapped objects", "B")
                made[-1].entries[sub] = Entry(index + at.MAPPING, sub, name, letter, "rw", 0, line=line)
        for added in made:
            eds.objects[added.index] = added
            for entry in added.entries.values():
                eds.take(entry)


def _parameter(eds: Description, line: int, index: int, number: int, mask: int, bases: tuple[int, ...]) -> Object:
    """Return a communication parameter: the identifier of the pre-defined connection set for the first four PDOs."""
    made = Object(index, f"PDO parameter {number + 1}", RECORD, line)
    subs = [k + 1 for k in range(len(_PARAMETERS)) if mask >> k & 1]
    made.entries[0] = Entry(index, 0, "Highest sub-index", "B", "const", max(subs), line=line)
    for sub in subs:
        name, default = _PARAMETERS[sub - 1], _EVENT_DRIVEN if sub == 2 else 0
        made.entries[sub] = Entry(index, sub, name, _PDO_LETTERS[sub], "rw", default, line=line)
    if 1 in subs:
        no_rtr, predefined = codes.NO_RTR if bases is codes.TPDO_BASES else 0, number < len(bases)
        made.entries[1].default = bases[number] + eds.node_id | no_rtr if predefined else codes.COB_ID_INVALID
        made.entries[1].has_node_id = predefined
    return made


# --- where the parts contradict each other: lists, identity, PDOs. Each becomes a finding; none stops a load ----

_OBJECT_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_COUNT_KEYS = ("SupportedObjects", "NrOfObjects", "NrOfEntries")
_SHOWN = 5
_NUMBERS = ("VendorNumber", "ProductNumber", "RevisionNumber")
_WITH_NODE_ID = (
    (at.COB_ID_EMCY, 0, codes.EMCY_BASE), (at.SDO_SERVER, 1, codes.SDO_REQUEST_BASE),
    (at.SDO_SERVER, 2, codes.SDO_RESPONSE_BASE),
)  # fmt: skip
_DEFAULT_DUMMIES = frozenset(range(1, 8))
_DIRECTIONS = {"ro": TPDO, "const": TPDO, "rwr": TPDO, "wo": RPDO, "rww": RPDO}  # CiA 306-1; rw: both


def check(file: EdsFile, eds: Description) -> None:
    """Compare the parts of the file, and set ``Entry.directions``."""
    for name in ("FileInfo", "MandatoryObjects"):
        if name.lower() not in file.sections:
            eds.add(0, f"no section [{name}]")
    if any(name in file.sections for name in _OBJECT_LISTS):
        _check_lists(file, eds)
    modules = file.sections.get("supportedmodules")
    if modules is not None and values.integer(modules.get("NrOfEntries") or "").value:
        eds.add(modules.line, "[SupportedModules]: objects of modules are not loaded")
    _check_parameter_values(file, eds)
    for index, sub, base in _WITH_NODE_ID:  # identifiers of EMCY and SDO
        entry = eds.entry(index, sub)
        if entry is not None and entry.initial == base:
            eds.add(entry.line, f"{entry.place} has {base:#x}: $NODEID+{base:#x} may be meant; the value stays")
    _check_identity(file.sections.get("deviceinfo"), eds)
    if eds.bit_rate and eds.bit_rates and eds.bit_rate not in eds.bit_rates:
        eds.add(0, f"Baudrate={eds.bit_rate // 1000}: [DeviceInfo] has BaudRate_{eds.bit_rate // 1000}=0")
    for entry in eds.entries():
        entry.directions = _DIRECTIONS.get(entry.access, TPDO | RPDO) if entry.mappable else 0
    for _, first, last, _, direction in PDOS:
        _check_pdos(eds, first, last, direction)


def _check_lists(file: EdsFile, eds: Description) -> None:
    listed: set[int] = set()
    known = file.objects.keys() | file.subs.keys()
    for name in _OBJECT_LISTS:
        section = file.sections.get(name)
        if section is None:
            continue
        own = [(key, text) for key, text in section.keys.items() if key[:1].isdigit()]
        key = next((key for key in _COUNT_KEYS if section.get(key)), _COUNT_KEYS[0])
        if values.integer(section.get(key) or "").value != len(own):
            section.say(key, f"the list has {len(own)}")
        for key, text in own:
            index = _listed_index(file, text)
            if index is None or index not in known:
                section.say(key, "the file has no such section")
                continue
            if values.integer(text).value != index:
                section.say(key, f"0x is missing; read as 0x{index:04X}")
            if index in listed:
                section.say(key, "listed twice")
            listed.add(index)
    unlisted = sorted((eds.objects.keys() & known) - listed)
    if unlisted:
        shown = ", ".join(f"0x{index:04X}" for index in unlisted[:_SHOWN]) + (", ..." if unlisted[_SHOWN:] else "")
        eds.add(eds.objects[unlisted[0]].line, f"{len(unlisted)} objects are in no list of objects: {shown}; loaded")


def _check_parameter_values(file: EdsFile, eds: Description) -> None:
    subs = [section for index in file.subs for section in file.subs[index].values()]
    given = [section for section in [*file.objects.values(), *subs] if section.get("ParameterValue")]
    if given and not eds.is_dcf:
        first = min(given, key=lambda section: section.line)
        problem = f"{len(given)} ParameterValues, but no [DeviceComissioning], as a DCF has; the DefaultValues apply"
        without = sum(not section.get("DefaultValue") for section in given)
        problem += f", where there is none ({without}) the ParameterValue" if without else ""
        first.say("ParameterValue", problem)


def _listed_index(file: EdsFile, text: str) -> int | None:
    """Return the index of a list: hexadecimal; decimal if only that names a section."""
    value = values.integer(text).value
    if value in file.objects or value in file.subs or text.strip()[:2].lower() == "0x":
        return value
    try:
        return int(text, 16)
    except ValueError:
        return value


def _check_identity(section: Section | None, eds: Description) -> None:
    """Fill 1018h from [DeviceInfo] where it has no default; report where they differ."""
    for sub, key in enumerate(_NUMBERS, 1):
        entry = eds.entry(at.IDENTITY, sub)
        if section is None or entry is None or not section.get(key):
            continue
        number, _, remark, _ = values.integer(section.get(key) or "")
        if number is None or not 0 <= number <= 0xFFFFFFFF:
            section.say(key, remark or "allowed are 0 to 0xFFFFFFFF")
        elif not entry.has_default and entry.value is None:
            entry.default = number
        elif entry.initial != number:
            section.say(key, f"{entry.place} has {entry.initial!r}, which applies")
    serial = eds.entry(at.IDENTITY, 4)
    if eds.serial is not None and serial is not None and serial.value is None:
        serial.value = eds.serial


def _check_pdos(eds: Description, first: int, last: int, direction: int) -> None:
    used: dict[int, int] = {}
    for index in sorted(index for index in eds.objects if first <= index <= last):
        entry = eds.entry(index, 1)
        cob_id = entry.initial if entry is not None else codes.COB_ID_INVALID
        if not isinstance(cob_id, int):
            continue
        valid, can_id = not cob_id & codes.COB_ID_INVALID, cob_id & codes.STANDARD_MASK
        line = eds.objects[index].line if entry is None else entry.line
        mapping = index + at.MAPPING
        if mapping not in eds.objects:
            eds.add(line, f"[{index:04X}]: no mapping object 0x{mapping:04X}; the PDO is inactive")
            continue
        if valid and cob_id & codes.EXTENDED_COB_ID:
            eds.add(line, f"[{index:04X}sub1] {cob_id:#x}: a 29-bit identifier, which is not supported; inactive")
        elif valid and codes.restricted(can_id):
            hint = "" if entry is None or entry.has_node_id or not can_id else f"; $NODEID+0x{can_id:X} may be meant"
            eds.add(line, f"[{index:04X}sub1] 0x{can_id:X}: a restricted identifier (CiA 301, 7.3.5); inactive{hint}")
        elif valid and can_id in used:
            eds.add(line, f"[{index:04X}sub1] 0x{can_id:X}: also the identifier of 0x{used[can_id]:04X}")
        if valid:
            used.setdefault(can_id, index)
            _check_transmission(eds, index, direction)
        _check_mapping(eds, mapping, direction)


def _check_transmission(eds: Description, index: int, direction: int) -> None:
    entry = eds.entry(index, 2)
    kind = entry.initial if entry is not None else None
    if entry is None or not isinstance(kind, int):
        return
    place = f"[{index:04X}sub2]"
    if kind <= codes.LAST_SYNCHRONOUS and at.COB_ID_SYNC not in eds.objects:
        problem = f"a synchronous PDO, but no object 1005h; SYNC is received on 0x{codes.SYNC_COB_ID:02X}"
        eds.add(entry.line, f"{place}: {problem}")
    elif direction == TPDO and codes.LAST_SYNCHRONOUS < kind < codes.EVENT_DRIVEN:
        problem = f"{kind} is reserved, or sent on a remote request, which is not supported; inactive"
        eds.add(entry.line, f"{place}: {problem}")


def _check_mapping(eds: Description, index: int, direction: int) -> None:
    mapping = eds.objects[index].entries
    count = mapping[0].initial if 0 in mapping else 0
    bits = 0
    for sub in range(1, count + 1 if isinstance(count, int) else 1):
        word = mapping[sub].initial if sub in mapping else None
        line = mapping[sub].line if sub in mapping else mapping[0].line
        place = f"[{index:04X}sub{sub:X}]"
        if not isinstance(word, int):
            eds.add(line, f"{place}: [{index:04X}sub0] has {count!r}, the entry does not exist; the PDO is inactive")
            return
        bits += word & 0xFF
        problem = _wrong(eds, word, direction)
        if problem:
            eds.add(line, f"{place} 0x{word:08X}: {problem}")
    if bits > 8 * 8:
        eds.add(mapping[0].line, f"[{index:04X}]: {bits} bits are mapped, 64 fit a PDO; the PDO is inactive")


def _wrong(eds: Description, word: int, direction: int) -> str:
    """Return what is wrong with a mapped entry, "" if nothing is; an entry that PDOMapping forbids becomes mappable."""
    index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
    dummies = _DEFAULT_DUMMIES if eds.dummies is None else eds.dummies
    if index in LETTER_OF_CODE and sub == 0:
        if direction == TPDO:
            return "a data type can be mapped into an RPDO only; the PDO is inactive"
        return "" if index in dummies else f"[DummyUsage] has no Dummy{index:04X}=1; the PDO is inactive"
    entry = eds.entry(index, sub)
    if entry is None:
        return "no such entry; the PDO is inactive"
    size = TYPES[entry.letter].size
    if size is not None and bits != 8 * size and not (entry.letter == "?" and bits == 1):
        return f"{entry.type.name} has {8 * size} bits, {bits} are mapped; the PDO is inactive"
    if not entry.directions & direction:
        entry.directions |= direction
        shown = "TPDO" if direction == TPDO else "RPDO"
        key = f"AccessType={entry.access}" if entry.mappable else "PDOMapping=0"
        return f"{entry.place} has {key}; taken as mappable into a {shown}"
    return ""
