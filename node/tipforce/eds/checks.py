"""Where the parts of an EDS contradict each other: lists, identity, PDOs. Each becomes a finding; none stops a load."""

from __future__ import annotations

from tipforce.device import codes, communication
from tipforce.device.object_dictionary import RPDO, TPDO
from tipforce.dictionary.types import LETTER_OF_CODE, TYPES
from tipforce.eds import values
from tipforce.eds.description import Description, Entry
from tipforce.eds.sections import EdsFile, Section

_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_COUNT_KEYS = ("SupportedObjects", "NrOfObjects", "NrOfEntries")
_SHOWN = 5
_IDENTITY = ("VendorNumber", "ProductNumber", "RevisionNumber")
_WITH_NODE_ID = (
    (communication.COB_ID_EMCY, 0, codes.EMCY_BASE), (communication.SDO_SERVER, 1, codes.SDO_REQUEST_BASE),
    (communication.SDO_SERVER, 2, codes.SDO_RESPONSE_BASE),
)  # fmt: skip
_DEFAULT_DUMMIES = frozenset(range(1, 8))
_PDOS = (
    (communication.RPDO, communication.LAST_RPDO, RPDO),
    (communication.TPDO, communication.LAST_TPDO, TPDO),
)


def check(file: EdsFile, found: Description) -> None:
    """Compare the parts of the file, and set ``Entry.directions``."""
    for name in ("FileInfo", "MandatoryObjects"):
        if name.lower() not in file.sections:
            found.add(0, f"no section [{name}]")
    if any(name in file.sections for name in _LISTS):
        _check_lists(file, found)
    if "supportedmodules" in file.sections and _count(file.sections["supportedmodules"], "NrOfEntries"):
        found.add(file.sections["supportedmodules"].line, "[SupportedModules]: objects of modules are not loaded")
    _check_parameter_values(file, found)
    _check_identifiers(found)
    _check_identity(file.sections.get("deviceinfo"), found)
    if found.bit_rate and found.bit_rates and found.bit_rate not in found.bit_rates:
        found.add(0, f"Baudrate={found.bit_rate // 1000}: [DeviceInfo] has BaudRate_{found.bit_rate // 1000}=0")
    for entry in found.entries():
        entry.directions = _directions(entry)
    for first, last, direction in _PDOS:
        _check_pdos(found, first, last, direction)


def _count(section: Section, *keys: str) -> int | None:
    text = next((section.get(key) for key in keys if section.get(key)), None)
    return None if text is None else values.integer(text).value


def _check_lists(file: EdsFile, found: Description) -> None:
    listed: set[int] = set()
    known = file.objects.keys() | file.subs.keys()
    for name in _LISTS:
        section = file.sections.get(name)
        if section is None:
            continue
        own = [(key, text) for key, text in section.keys.items() if key[:1].isdigit()]
        told = _count(section, *_COUNT_KEYS)
        if told != len(own):
            key = next((key for key in _COUNT_KEYS if section.get(key)), _COUNT_KEYS[0])
            found.findings.append(section.finding(key, f"the list has {len(own)}"))
        for key, text in own:
            index = _listed_index(file, text)
            if index is None or index not in known:
                found.findings.append(section.finding(key, "the file has no such section"))
                continue
            if values.integer(text).value != index:
                found.findings.append(section.finding(key, f"0x is missing; read as 0x{index:04X}"))
            if index in listed:
                found.findings.append(section.finding(key, "listed twice"))
            listed.add(index)
    unlisted = sorted((found.objects.keys() & known) - listed)
    if unlisted:
        shown = ", ".join(f"0x{index:04X}" for index in unlisted[:_SHOWN]) + (", ..." if unlisted[_SHOWN:] else "")
        found.add(
            found.objects[unlisted[0]].line, f"{len(unlisted)} objects are in no list of objects: {shown}; loaded"
        )


def _check_parameter_values(file: EdsFile, found: Description) -> None:
    """Report the values of a DCF in a file that configures no node."""
    subs = [section for index in file.subs for section in file.subs[index].values()]
    given = [one for one in [*file.objects.values(), *subs] if one.get("ParameterValue")]
    if given and not found.is_dcf:
        first = min(given, key=lambda one: one.line)
        told = f"{len(given)} ParameterValues, but no [DeviceComissioning], as a DCF has; the DefaultValues apply"
        without = sum(not one.get("DefaultValue") for one in given)
        told += f", where there is none ({without}) the ParameterValue" if without else ""
        found.findings.append(first.finding("ParameterValue", told))


def _listed_index(file: EdsFile, text: str) -> int | None:
    """Return the index of a list: hexadecimal; decimal if only that names a section."""
    value = values.integer(text).value
    bare = text.strip()
    if value in file.objects or value in file.subs or bare[:2].lower() == "0x":
        return value
    try:
        return int(bare, 16)
    except ValueError:
        return value


def _check_identifiers(found: Description) -> None:
    """Report identifiers of EMCY and SDO without the node-id."""
    for index, sub, base in _WITH_NODE_ID:
        entry = found.entry(index, sub)
        if entry is not None and entry.initial == base:
            found.add(entry.line, f"{entry.place} has {base:#x}: $NODEID+{base:#x} may be meant; the value stays")


def _check_identity(section: Section | None, found: Description) -> None:
    """Fill 1018h from [DeviceInfo] where it has no default; report where they differ."""
    for sub, key in enumerate(_IDENTITY, 1):
        entry = found.entry(communication.IDENTITY, sub)
        text = section.get(key) if section is not None else None
        if section is None or entry is None or not text:
            continue
        number, _, remark = values.integer(text)
        if number is None or not 0 <= number <= 0xFFFFFFFF:
            found.findings.append(section.finding(key, remark or "allowed are 0 to 0xFFFFFFFF"))
        elif not entry.has_default and entry.value is None:
            entry.default = number
        elif entry.initial != number:
            found.findings.append(section.finding(key, f"{entry.place} has {entry.initial!r}, which applies"))
    serial = found.entry(communication.IDENTITY, 4)
    if found.serial is not None and serial is not None and serial.value is None:
        serial.value = found.serial


def _directions(entry: Entry) -> int:
    """Return the PDOs that may map an entry, by PDOMapping and AccessType (CiA 306-1)."""
    if not entry.mappable:
        return 0
    return {"ro": TPDO, "const": TPDO, "rwr": TPDO, "wo": RPDO, "rww": RPDO}.get(entry.access, TPDO | RPDO)


# --- PDOs -----------------------------------------------------------------------------------------------------


def _check_pdos(found: Description, first: int, last: int, direction: int) -> None:
    used: dict[int, int] = {}
    for index in sorted(index for index in found.objects if first <= index <= last):
        entry = found.entry(index, 1)
        cob_id = entry.initial if entry is not None else codes.COB_ID_INVALID
        if not isinstance(cob_id, int):
            continue
        valid = not cob_id & codes.COB_ID_INVALID
        can_id = cob_id & codes.STANDARD_MASK
        line = found.objects[index].line if entry is None else entry.line
        if index + communication.MAPPING not in found.objects:
            found.add(
                line, f"[{index:04X}]: no mapping object 0x{index + communication.MAPPING:04X}; the PDO is inactive"
            )
            continue
        if valid and cob_id & codes.EXTENDED_COB_ID:
            found.add(line, f"[{index:04X}sub1] {cob_id:#x}: a 29-bit identifier, which is not supported; inactive")
        elif valid and codes.restricted(can_id):
            hint = "" if entry is None or entry.has_node_id or not can_id else f"; $NODEID+0x{can_id:X} may be meant"
            found.add(line, f"[{index:04X}sub1] 0x{can_id:X}: a restricted identifier (CiA 301, 7.3.5); inactive{hint}")
        elif valid and can_id in used:
            found.add(line, f"[{index:04X}sub1] 0x{can_id:X}: also the identifier of 0x{used[can_id]:04X}")
        if valid:
            used.setdefault(can_id, index)
            _check_transmission(found, index, direction)
        _check_mapping(found, index + communication.MAPPING, direction)


def _check_transmission(found: Description, index: int, direction: int) -> None:
    entry = found.entry(index, 2)
    kind = entry.initial if entry is not None else None
    if entry is None or not isinstance(kind, int):
        return
    told = ""
    if kind <= codes.LAST_SYNCHRONOUS and communication.COB_ID_SYNC not in found.objects:
        told = f"a synchronous PDO, but no object 1005h; SYNC is received on 0x{codes.SYNC_COB_ID:02X}"
    elif direction == TPDO and codes.LAST_SYNCHRONOUS < kind < codes.EVENT_DRIVEN:
        told = f"{kind} is reserved, or sent on a remote request, which is not supported; inactive"
    if told:
        found.add(entry.line, f"[{index:04X}sub2]: {told}")


def _check_mapping(found: Description, index: int, direction: int) -> None:
    mapping = found.objects[index].entries
    count = mapping[0].initial if 0 in mapping else 0
    bits = 0
    for sub in range(1, count + 1 if isinstance(count, int) else 1):
        word = mapping[sub].initial if sub in mapping else None
        line = mapping[sub].line if sub in mapping else mapping[0].line
        place = f"[{index:04X}sub{sub:X}]"
        if not isinstance(word, int):
            found.add(line, f"{place}: [{index:04X}sub0] has {count!r}, the entry does not exist; the PDO is inactive")
            return
        bits += word & 0xFF
        told = _wrong(found, word, direction)
        if told:
            found.add(line, f"{place} 0x{word:08X}: {told}")
    if bits > 8 * 8:
        found.add(mapping[0].line, f"[{index:04X}]: {bits} bits are mapped, 64 fit a PDO; the PDO is inactive")


def _wrong(found: Description, word: int, direction: int) -> str:
    """Return what is wrong with a mapped entry, "" if nothing is; an entry that PDOMapping forbids becomes mappable."""
    index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
    dummies = _DEFAULT_DUMMIES if found.dummies is None else found.dummies
    if index in LETTER_OF_CODE and sub == 0:
        if direction == TPDO:
            return "a data type can be mapped into an RPDO only; the PDO is inactive"
        return "" if index in dummies else f"[DummyUsage] has no Dummy{index:04X}=1; the PDO is inactive"
    entry = found.entry(index, sub)
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
