"""Files that leave CiA 306: each loads, says so with its line, and is read as the warning says."""

import random
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from bench.fuzz import fuzz_file

from canopen_device.eds import Description, read_eds
from canopen_device.errors import InputError
from canopen_device.testing import MemoryStore
from eds.samples import INFO, MANDATORY, Talk, described, pdo, record, sound, text, var


def looked(found: Description, key: Any, name: Any) -> Any:
    """The attribute of an entry, of an "object.", or the result of a function."""
    if callable(name):
        return name(found)
    if name.startswith("object."):
        return getattr(found.objects[key], name.removeprefix("object."))
    return getattr(found.find(key if isinstance(key, tuple) else (key, 0)), name)


ODD: dict[str, tuple[str, str, Any, Any, Any]] = {  # content, a finding, a key and attribute (or a function), its value
    "octal": (text(var("2000", 6, "rw", "010")), r"DefaultValue=010: read as octal: 8", 0x2000, "default", 8),
    "decimal 08": (text(var("2000", 6, "rw", "08")), r"read as decimal 8", 0x2000, "default", 8),
    "no 0x": (text(var("2000", 6, "rw", "FF")), r"0x is missing", 0x2000, "default", 255),
    "h suffix": (text(var("2000", 6, "rw", "1Fh")), r"0x is missing", 0x2000, "default", 0x1F),
    "too large": (text(var("2000", 5, "rw", "0x1FF")), r"0 to 255; read as 255", 0x2000, "default", 255),
    "negative unsigned": (text(var("2000", 7, "rw", "-1")), r"read as 4294967295", 0x2000, "default", 0xFFFFFFFF),
    "unsigned in signed": (text(var("2000", 2, "rw", "255")), r"not in INTEGER8; read as -1", 0x2000, "default", -1),
    "no number": (text(var("2000", 6, "rw", "on")), r"DefaultValue=on: not a number; read as 0", 0x2000, "default", 0),
    "real integer": (text(var("2000", 6, "rw", "5.0")), r"read as the integer 5", 0x2000, "default", 5),
    "decimal comma": (text(var("2000", 8, "rw", "1,5")), r"the decimal sign is a point", 0x2000, "default", 1.5),
    "inline comment": (text(var("2000", 6, "rw", "5 ; five")), r"taken as a comment", 0x2000, "default", 5),
    "NODEID": (text(var("2000", 7, "rw", "NodeId+0x180")), r"the form is \$NODEID", 0x2000, "default", 0x185),
    "two NODEID": (text(var("2000", 7, "rw", "$NODEID+$NODEID+1")), r"it is added once", 0x2000, "default", 6),
    "product": (text(var("2000", 7, "rw", "$NODEID*2")),
        r"sum of numbers and \$NODEID; read as 0", 0x2000, "default", 0),
    "default beyond limit": (text(var("2000", 5, "rw", "9", HighLimit="8")),
        r"outside the limits any to 8", 0x2000, "default", 9),
    "limits reversed": (text(var("2000", 5, "rw", "9", LowLimit="8", HighLimit="2")),
        r"LowLimit=8: above HighLimit", 0x2000, "high", None),
    "limit below the type": (text(var("2000", 5, "rw", "0", LowLimit="-1", HighLimit="8")),
        r"LowLimit=-1: not in UNSIGNED8; the limit does not apply", 0x2000, "low", None),
    "limits of nothing": (text(var("2000", 5, "rw", "0", LowLimit="0", HighLimit="0")),
        r"LowLimit=0: HighLimit, too, is 0", 0x2000, "high", None),
    "no data type": (text("[2000]\nParameterName=x\nAccessType=rw\n"),
        r"DataType missing: no DataType; read as OCTET_STRING", 0x2000, "letter", "o"),
    "standard data type": (text("[1017]\nParameterName=x\nAccessType=rw\n"),
        r"no DataType; read as UNSIGNED16 of CiA 301", 0x1017, "letter", "H"),
    "unknown data type": (text(var("2000", 0x7F)), r"DataType=0x007F: no type of CiA 301", 0x2000, "letter", "o"),
    "heartbeat as text": (text(var("1017", 9, "rw", "x")),
        r"DataType=0x0009: CiA 301 has UNSIGNED16; read as it", 0x1017, "letter", "H"),
    "no name": (text("[2000]\nDataType=5\nAccessType=rw\n"),
        r"ParameterName missing: called '2000h'", 0x2000, "object.name", "2000h"),
    "access": (text(var("2000", 5, "any")), r"AccessType=any: allowed are ro, wo", 0x2000, "access", "rw"),
    "access in words": (text(var("2000", 5, "Read only")), r"read as ro", 0x2000, "access", "ro"),
    "comment behind a section": (text(var("2000", 5, "rw", "7")).replace("[2000]", "[2000] // lamp"),
        r"'\[2000\] // lamp': the text after \] is taken as a comment", 0x2000, "default", 7),
    "open section": (text(var("2000", 5, "rw", "7")).replace("[2000]", "[2000"),
        r"'\[2000': \] is missing", 0x2000, "default", 7),
    "section of no form": (
        text(var("2000sub1h", 5)),
        r"\[2000sub1h\]: the forms are \[2000\] and \[2000sub1\]; .* skipped",
        None, lambda found: 0x2000 in found.objects, False,
    ),
    "colon": (text(var("2000", 5, "rw", "7")).replace("DefaultValue=7", "DefaultValue: 7"),
        r"the form is key=value; read so", 0x2000, "default", 7),
    "quotes": (text(var("2000", 7, "rw", '"0x10"')), r"quotes and brackets are no part", 0x2000, "default", 0x10),
    "brackets": (text(var("2000", 7, "rw", "($NODEID+0x180)")), r"read without", 0x2000, "default", 0x185),
    "string outside Latin-1": (text(var("2000", 9, "rw", "\u65e5")), r"not in VISIBLE_STRING", 0x2000, "default", "?"),
    "limit of no number": (text(var("2000", 8, "rw", "1", HighLimit="3.5e38")),
        r"HighLimit=3.5e38: not in REAL32; the limit does not", 0x2000, "high", None),
    "a long value": (text(var("2000", 5, "rw", "9" * 999)), r"DefaultValue=9{80}\.\.\.: ", 0x2000, "default", 0),
    "sub number": (
        text(record("2000", var("2000sub0", 5, "ro", "1"), var("2000sub1", 5)).replace("SubNumber=2", "SubNumber=9")),
        r"SubNumber=9: the file has 2 sections", None, lambda found: len(found.objects[0x2000].entries), 2,
    ),
    "sub 0 value": (text(record("2000", var("2000sub0", 5, "ro", "4"), var("2000sub1", 5))),
        r"DefaultValue=4: the highest sub-index is 1; the value stays", 0x2000, "default", 4),
    "no sub 0": (text(record("2000", var("2000sub1", 5), var("2000subA", 5))),
        r"no sub-index 0; added as UNSIGNED8 ro", 0x2000, "default", 10),
    "no object section": (text() + var("2000sub0", 5, "ro", "1") + var("2000sub1", 5, "rw", "3"),
        r"no section \[2000\]; read as a RECORD", (0x2000, 1), "default", 3),
    "var with subs": (text(var("2000", 5), var("2000sub0", 5, "ro", "1"), var("2000sub1", 5, "rw", "3")),
        r"the object has sub-indices; read as a RECORD", (0x2000, 1), "default", 3),
    "record without subs": (text(var("2000", 5, "rw", "3", ObjectType="0x8")),
        r"no sub-index; read as a VAR", 0x2000, "default", 3),
    "object twice": (text(var("2000", 5, "rw", "1"), var("2000", 5, "rw", "2")),
        r"\[2000\]: the section is already there at line \d+", 0x2000, "default", 1),
    "same number": (text(var("2000", 5, "rw", "1"), var("0x2000", 5, "rw", "2")),
        r"the same as \[2000\]", 0x2000, "default", 1),
    "comment behind a number": (text(var("2000", 6, "rw", "5 # five", ObjectType="0x7 // VAR")),
        r"DefaultValue=5 # five: the text after # is", 0x2000, "default", 5),
    "comment behind the access": (text(var("2000", 6, "ro // fixed")),
        r"AccessType=ro // fixed: the text after // is", 0x2000, "access", "ro"),
    "negative real": (text(var("2000", 3, "rw", "-5.0")), r"read as the integer -5", 0x2000, "default", -5),
    "0x and h": (text(var("2000", 6, "rw", "0x1Fh")), r"read as hexadecimal", 0x2000, "default", 0x1F),
    "object type in words": (
        text(record("2000", var("2000sub0", 5, "ro", "1"), var("2000sub1", 5, "rw", "3"), code="Array")),
        r"ObjectType=Array: the form is a number; read as 0x8", 0x2000, "object.code", 8,
    ),
    "data type in words": (text(var("2000", 6).replace("DataType=0x0006", "DataType=Integer16")),
        r"the form is a number; read as 0x0003", 0x2000, "letter", "h"),
    "mapping in words": (text(var("2000", 6, PDOMapping="yes")),
        r"PDOMapping=yes: the form is 0 or 1", 0x2000, "mappable", True),
    "mapping as in an XDD": (text(var("2000", 6, PDOMapping="optional")),
        r"PDOMapping=optional: the form is 0 or 1; read as 1", 0x2000, "mappable", True),
    "key with a blank": (text().replace("SupportedObjects=3", "Supported Objects=3"),
        r"Supported Objects: a key has no blanks", 0x1018, "default", 1),
    "no error register": (text(mandatory=MANDATORY.replace("[1001]", "[1002]")),
        r"no object 0x1001, .* added with the value 0", 0x1001, "default", 0),
    "no identity": (text(mandatory=MANDATORY[: MANDATORY.index("[1018]")]),
        r"added with the numbers of \[DeviceInfo\]", (0x1018, 1), "default", 0x12),
    "EMCY without the node-id": (text(var("1014", 7, "rw", "0x80")),
        r"\$NODEID\+0x80 may be meant; the value stays", 0x1014, "default", 0x80),
    "key twice": (text(var("2000", 5, "rw", "1") + "DefaultValue=2\n"),
        r"DefaultValue: the key is already there", 0x2000, "default", 1),
    "words": (text() + "just words\n", r"'just words': allowed are", 0x1018, "default", 1),
    "listed, missing": (text().replace("[1000]", "[1009]"),
        r"\[MandatoryObjects\] 1=0x1000: the file has no such section", 0x1000, "default", 0),
    "list without 0x": (text().replace("1=0x1000", "1=1000"),
        r"1=1000: 0x is missing; read as 0x1000", 0x1018, "default", 1),
    "list count": (text().replace("SupportedObjects=3", "SupportedObjects=7"),
        r"SupportedObjects=7: the list has 3", 0x1018, "default", 1),
    "no lists at all": (INFO + MANDATORY, r"any.eds: no section \[MandatoryObjects\]", 0x1018, "default", 1),
    "vendor differs": (text().replace("VendorNumber=0x12", "VendorNumber=0x13"),
        r"0x1018:01 has 18, which applies", (0x1018, 1), "default", 0x12),
    "dummy with h": ("[DummyUsage]\nDummy5h=1\nDummyX=1\n" + text(),
        r"DummyX=1: the form is Dummy0005=1; skipped", None, lambda found: found.dummies, {5}),
    "pdo count": (text(info=INFO + "NrOfTXPDO=4\n"), r"NrOfTXPDO=4: the file has 0 PDOs", 0x1018, "default", 1),
    "not mappable": (text(var("2000", 5, "rw", "", PDOMapping="0"), pdo(0x1800, "$NODEID+0x180", 255, 0x20000008)),
        r"0x2000:00 has PDOMapping=0; taken as mappable into a TPDO", 0x2000, "directions", 1),
    "mapped length": (text(var("2000", 5), pdo(0x1800, "$NODEID+0x180", 255, 0x20000010)),
        r"UNSIGNED8 has 8 bits, 16 are mapped", 0x2000, "default", 0),
    "mapped, missing": (text(pdo(0x1800, "$NODEID+0x180", 255, 0x20000010)),
        r"0x20000010: no such entry; the PDO is inactive", 0x1018, "default", 1),
    "restricted": (text(var("2000", 5), pdo(0x1800, "0x180", 255, 0x20000008)),
        r"restricted identifier .* \$NODEID\+0x180 may be meant", 0x2000, "default", 0),
    "29 bits": (text(var("2000", 5), pdo(0x1800, "0x20000185", 255, 0x20000008)),
        r"a 29-bit identifier", 0x2000, "default", 0),
    "synchronous without 1005h": (text(var("2000", 5), pdo(0x1800, "$NODEID+0x180", 1, 0x20000008)),
        r"no object 1005h; SYNC is received on 0x80", 0x2000, "default", 0),
    "sent on a remote request": (text(var("2000", 5), pdo(0x1800, "$NODEID+0x180", 253, 0x20000008)),
        r"\[1800sub2\]: 253 is reserved, or sent on a remote request", (0x1800, 2), "default", 253),
    "parameter value in an EDS": (text(var("2000", 5, "rw", "1", ParameterValue="9")),
        r"1 ParameterValues, but no \[DeviceComissioning\]", 0x2000, "initial", 1),
    "stored EDS as a number": (text(var("1021", 7, "ro")),
        r"\[1021\] DataType=0x0007: CiA 301 has DOMAIN; read as it", 0x1021, "letter", "D"),
    "mapping as a large number": (text(pdo(0x1800, "$NODEID+0x180", 255), var("1A01", 7, "rw", "0x20000008")),
        r"\[1A01\] DataType=0x0007: CiA 301 has UNSIGNED8; read as it", 0x1A01, "default", 255),
    "stored EDS with sub-indices": (
        text(record("1021", var("1021sub0", 5, "ro", "1"), var("1021sub1", 8, "ro", "1.5"))),
        r"DataType=0x0005: CiA 301 has DOMAIN; read as it", (0x1021, 1), "default", 1.5,
    ),
    "real sub-index 0": (text(record("2000", var("2000sub0", 8, "ro", "1.5"))),
        r"\[2000sub0\]: REAL32; CiA 301 has UNSIGNED8; the type stays", (0x2000, 0), "default", 1.5),
    "commissioning of another node": ("[DeviceCommissioning]\nNodeID=7\n" + text(),
        r"NodeID=7: loaded as node 5", None, lambda found: found.node_id, 5),
    "compact value out of range": (
        text("[2000]\nParameterName=x\nObjectType=8\nDataType=5\nAccessType=rw\nCompactSubObj=2\n[2000Value]\nNrOfEntries=3\n3=1\n"),
        r"\[2000Value\] 3=1: CompactSubObj is 2", 0x2000, "default", 2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ODD)
def test_it_loads_and_says_so(name: str, tmp_path: Path) -> None:
    content, message, key, attribute, expected = ODD[name]
    found = described(tmp_path, content)
    about = [line for line in found.warnings if re.search(message, line)]
    assert about, found.warnings
    assert re.match(r"any\.eds(:\d+)?: ", about[0])
    assert looked(found, key, attribute) == expected
    talk = Talk(found)
    for entry in found.entries():
        assert talk.upload(entry.index, entry.sub) is not None
    assert len(found.warnings) < 6, found.warnings


@pytest.mark.parametrize(
    "change",
    [
        str.lower,
        lambda content: content.replace("\n", "\r\n"),
        lambda content: content.replace("\n", "\r"),
        lambda content: content.replace("=", " = ").replace("[", "  [").replace("]", "] "),
        lambda content: ";a comment\n\n" + content.replace("[1000]", "# another\n[1000]"),
        lambda content: "\ufeff" + content,
        lambda content: content.replace("0x", "0X").replace("sub", "Sub"),
    ],
    ids=["lower case", "CRLF", "CR", "spaces", "comments", "byte order mark", "upper case"],
)
def test_spelling_that_changes_nothing(change: Callable[[str], str], tmp_path: Path) -> None:
    content = text(var("2000", 6, "rw", "0xA5"), pdo(0x1400, "$NODEID+0x200", 255, 0x20000010))
    found = sound(tmp_path, change(content))
    plain = described(tmp_path, content)
    assert [(e.index, e.sub, e.letter, e.access, e.default) for e in found.entries()] == [
        (e.index, e.sub, e.letter, e.access, e.default) for e in plain.entries()
    ]


def test_a_pdo_on_a_remote_request_is_never_sent(tmp_path: Path) -> None:
    for kind, sent in ((253, []), (255, [(0x185, b"\0")])):
        talk = Talk(described(tmp_path, text(var("2000", 5), pdo(0x1800, "$NODEID+0x180", kind, 0x20000008))))
        assert talk.step([(0, b"\x01\x05")]) == sent


def test_the_suffix_dcf_makes_a_dcf(tmp_path: Path) -> None:
    found = described(tmp_path, text(var("2000", 5, "rw", "1", ParameterValue="9")), name="any.dcf")
    assert found.find(0x2000).initial == 9
    assert found.warnings == ["any.dcf: no section [DeviceComissioning], as a DCF has"]


def test_1010h_reads_as_the_file_has_it(tmp_path: Path) -> None:
    given = record("1010", var("1010sub0", 5, "ro", "2"), var("1010sub1", 7, "rw", "0"), var("1010sub2", 7), code="0x8")
    talk = Talk(described(tmp_path, text(given)), MemoryStore())
    assert talk.upload(0x1010, 1) == bytes(4)
    assert talk.upload(0x1010, 2) == b"\1\0\0\0"  # no DefaultValue: the device stores on command
    assert talk.download(0x1010, 1, b"save") == 0


def test_encodings(tmp_path: Path) -> None:
    content = text(var("2000", 9, "rw", "Grüße °C"))
    assert described(tmp_path, content).warnings == []
    for encoded, said in (
        (content.encode("cp1252"), "read as Windows-1252"), (content.encode("utf-16"), "UTF-16"),
        (content.encode("utf-16-le"), "UTF-16"), (content.encode("utf-16-be"), "UTF-16"),
        (b"\xfe\xff" + content.encode("utf-16-be"), "UTF-16"),
    ):  # fmt: skip
        found = described(tmp_path, encoded)
        assert [said in line for line in found.warnings] == [True]
        assert found.find(0x2000).default == "Grüße °C"
        assert Talk(found).upload(0x2000) == "Grüße °C".encode("latin-1")


@pytest.mark.parametrize("content", [b"", b"hello", bytes(range(256)) * 9, b"[FileInfo]\n", b"PK\3\4" + bytes(400)])
def test_what_is_no_eds_is_refused(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"any\.eds: no "):
        described(tmp_path, content)
    for path, message in ((tmp_path, r"Is a directory"), ("/dev/zero", r"more than 33554432 bytes")):
        with pytest.raises(InputError, match=message):
            read_eds(path, 5)


def test_damaged_files_never_raise_anything_else(tmp_path: Path) -> None:
    """Lines removed, doubled, changed, 60 times: a description whose device works, or InputError."""
    rng = random.Random(17)
    compact = "[2100]\nParameterName=G\nObjectType=8\nDataType=6\nAccessType=rw\nCompactSubObj=4\n[2100Value]\n1=7\n"
    content = text(
        var("1005", 7, "rw", "0x80"), var("1006", 7, "rw", "1000"), var("1014", 7, "rw", "$NODEID+0x80"),
        var("1017", 6, "rw", "100"), record("1010", var("1010sub0", 5, "ro", "1"), var("1010sub1", 7)),
        record("1016", var("1016sub0", 5, "ro", "1"), var("1016sub1", 7, "rw", "0x00070064")), compact,
        var("2000", 5, "rw", "9"), var("2001", 8, "rw", "1.5"), pdo(0x1400, "$NODEID+0x200", 1, 0x20000008),
        pdo(0x1800, "$NODEID+0x180", 255, 0x20000008, 0x20010020, event_ms=20),
        info=INFO + "NrOfTXPDO=3\nCompactPDO=0x1F\n",
    )  # fmt: skip
    loaded = 0
    for _ in range(60):
        lines = content.splitlines()
        for _ in range(rng.randrange(1, 12)):
            k = rng.randrange(len(lines))
            key, equal, _ = lines[k].partition("=")
            value = rng.choice(["", "-1", "0xFFFFFFFF", "1e99", "$NODEID", "zz", "9" * 50, "0x9", "8"])
            at = rng.randrange(len(lines[k]) + 1)
            changed = lines[k][:at] + chr(rng.randrange(32, 300)) + lines[k][at + 1 :]
            lines[k : k + 1] = rng.choice([[], [rng.choice(lines), lines[k]], [key + equal + value], [changed]])
        with suppress(InputError):
            described(tmp_path, "\n".join(lines))
            fuzz_file(tmp_path / "any.eds", 150, seed=17)
            loaded += 1
    assert loaded > 40
