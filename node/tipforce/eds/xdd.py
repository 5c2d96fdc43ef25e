"""A device description as XDD (CiA 311), for the tools that read XML."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from tipforce.device import communication
from tipforce.device.object_dictionary import RPDO, TPDO
from tipforce.dictionary.types import Value
from tipforce.eds.description import Description, Entry, Object

_NAMESPACE = "http://www.canopen.org/xml/1.1"
_HEADER = """\
    <ProfileHeader>
      <ProfileIdentification>{identification}</ProfileIdentification>
      <ProfileRevision>1.1</ProfileRevision>
      <ProfileName/>
      <ProfileSource/>
      <ProfileClassID>{kind}</ProfileClassID>
      <ISO15745Reference>
        <ISO15745Part>1</ISO15745Part>
        <ISO15745Edition>1</ISO15745Edition>
        <ProfileTechnology>CANopen</ProfileTechnology>
      </ISO15745Reference>
    </ProfileHeader>
"""
_FUNCTION = """\
      <co:DeviceFunction>
        <co:capabilities>
          <co:characteristicsList>
            <co:characteristic>
              <co:characteristicName><label lang="en">Protocol</label></co:characteristicName>
              <co:characteristicContent><label lang="en">CANopen</label></co:characteristicContent>
            </co:characteristic>
          </co:characteristicsList>
        </co:capabilities>
      </co:DeviceFunction>
"""
_DATE = "2026-01-01"  # the text is the same at each run
_LIST = {"mandatoryObjects": 0, "optionalObjects": 1, "manufacturerObjects": 2}
_KBIT = 1000


def xdd_text(found: Description) -> str:
    """Return the XDD of a device; values with $NODEID are written with it.

    As in the schema, elements that it declares globally have the namespace, those below a type have none.
    """
    name = quoteattr(found.path.stem + ".xdd")
    body = f'formatName="CANopen" formatVersion="1.0" fileName={name} fileCreator="tipforce"'
    body += f' fileCreationDate="{_DATE}" fileVersion="1"'
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>\n',
        f'<co:ISO15745ProfileContainer xmlns:co="{_NAMESPACE}" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">\n',
        "  <co:ISO15745Profile>\n",
        _HEADER.format(identification="CANopen device profile", kind="Device"),
        f'    <ProfileBody xsi:type="co:ProfileBody_Device_CANopen" {body} supportedLanguages="en">\n',
        *_identity(found),
        _FUNCTION,
        "    </ProfileBody>\n  </co:ISO15745Profile>\n  <co:ISO15745Profile>\n",
        _HEADER.format(identification="CANopen communication network profile", kind="CommunicationNetwork"),
        f'    <ProfileBody xsi:type="co:ProfileBody_CommunicationNetwork_CANopen" {body}>\n',
        "      <ApplicationLayers>\n",
        *_objects(found),
        *_dummies(found),
        "      </ApplicationLayers>\n",
        *_transport(found),
        "    </ProfileBody>\n  </co:ISO15745Profile>\n</co:ISO15745ProfileContainer>\n",
    ]
    return "".join(lines)


def _identity(found: Description) -> list[str]:
    identity = [found.entry(communication.IDENTITY, sub) for sub in (1, 2)]
    vendor, product = (f"0x{int(one.default):08X}" if one is not None else "" for one in identity)
    lines = ["      <co:DeviceIdentity>\n"]
    for name, text in (
        ("vendorName", found.vendor_name),
        ("vendorID", vendor),
        ("productName", found.product_name),
        ("productID", product),
    ):
        lines.append(f"        <co:{name}>{_escaped(text)}</co:{name}>\n")
    return [*lines, "      </co:DeviceIdentity>\n"]


def _dummies(found: Description) -> list[str]:
    """Return the data types that an RPDO may map as placeholders."""
    if found.dummies is None:
        return []
    entries = "".join(
        f'          <dummy entry="Dummy{code:04X}={int(code in found.dummies)}"/>\n' for code in range(1, 8)
    )
    return [f"        <dummyUsage>\n{entries}        </dummyUsage>\n"]


def _escaped(text: str) -> str:
    return quoteattr(text)[1:-1]


def _objects(found: Description) -> list[str]:
    groups = [0, 0, 0]
    for index in found.objects:
        own = communication.FIRST_MANUFACTURER <= index <= communication.LAST_MANUFACTURER
        groups[0 if index in communication.MANDATORY else 2 if own else 1] += 1
    counts = " ".join(f'{name}="{groups[number]}"' for name, number in _LIST.items())
    lines = [f"        <co:CANopenObjectList {counts}>\n"]
    for _, one in sorted(found.objects.items()):
        lines += _object(one, found.node_id)
    return [*lines, "        </co:CANopenObjectList>\n"]


def _object(one: Object, node_id: int) -> list[str]:
    head = f'          <CANopenObject index="{one.index:04X}" name={quoteattr(one.name)} objectType="{one.code}"'
    if set(one.entries) == {0} and one.entries[0].sub == 0 and one.code in (2, 7):
        return [f"{head}{_attributes(one.entries[0], node_id)}/>\n"]
    lines = [f'{head} subNumber="{len(one.entries)}">\n']
    for sub, entry in sorted(one.entries.items()):
        head = f'subIndex="{sub:02X}" name={quoteattr(entry.name)} objectType="7"'
        lines.append(f"            <CANopenSubObject {head}{_attributes(entry, node_id)}/>\n")
    return [*lines, "          </CANopenObject>\n"]


def _attributes(entry: Entry, node_id: int) -> str:
    access = "rw" if entry.access in ("rwr", "rww") else entry.access
    mapping = {0: "no", TPDO: "TPDO", RPDO: "RPDO"}.get(entry.directions, "optional")
    text = f' dataType="{entry.type.code:04X}" accessType="{access}"'
    if entry.has_default or entry.default:
        text += f" defaultValue={quoteattr(_value(entry, entry.default, node_id))}"
    for name, limit in (("lowLimit", entry.low), ("highLimit", entry.high)):
        if limit is not None:
            text += f" {name}={quoteattr(_value(entry, limit, 0))}"
    return f'{text} PDOmapping="{mapping}"'


def _value(entry: Entry, value: Value, node_id: int) -> str:
    if entry.has_node_id and node_id and isinstance(value, int):
        return f"$NODEID+0x{value - node_id:X}"
    return value.hex().upper() if isinstance(value, bytes) else repr(value) if isinstance(value, float) else str(value)


def _transport(found: Description) -> list[str]:
    rates = found.bit_rates or (1_000_000,)
    pdos = [
        sum(first <= index <= last for index in found.objects)
        for first, last in (
            (communication.RPDO, communication.LAST_RPDO), (communication.TPDO, communication.LAST_TPDO)
        )
    ]  # fmt: skip
    features = f'granularity="8" nrOfRxPDO="{pdos[0]}" nrOfTxPDO="{pdos[1]}" bootUpSlave="true"'
    lss = str(found.lss).lower()
    return [
        "      <TransportLayers>\n        <PhysicalLayer>\n",
        f'          <baudRate defaultValue="{max(rates) // _KBIT} Kbps">\n',
        *(f'            <supportedBaudRate value="{rate // _KBIT} Kbps"/>\n' for rate in rates),
        "          </baudRate>\n        </PhysicalLayer>\n      </TransportLayers>\n      <NetworkManagement>\n",
        f'        <CANopenGeneralFeatures {features} layerSettingServiceSlave="{lss}"/>\n',
        "      </NetworkManagement>\n",
    ]
