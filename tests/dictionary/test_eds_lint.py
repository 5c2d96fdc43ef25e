"""The lint is silent about our EDS and names each fault that is put in."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dictionary.eds_lint import lint_eds
from tipforce.dictionary.eds import eds_text

TEXT = eds_text(3)


@pytest.mark.parametrize(("n", "simulated"), [(n, s) for n in range(3, 9) for s in (False, True)])
def test_ours_is_clean(n: int, simulated: bool) -> None:
    assert lint_eds(eds_text(n, simulated)) == []


def test_comments_case_and_crlf_are_no_fault() -> None:
    text = "; a comment\n" + TEXT.replace("[2105sub1]", "[2105SUB1]").replace("SubNumber", "SUBNUMBER")
    assert lint_eds(text.replace("\n", "\r\n")) == []


def _edited(section: str, old: str, new: str) -> str:
    start = TEXT.index(f"[{section}]\n")
    end = TEXT.find("\n\n", start)
    body = TEXT[start:end]
    assert body.count(old) == 1, (section, old, body)
    return TEXT[:start] + body.replace(old, new) + TEXT[end:]


def _without(section: str) -> str:
    found = re.sub(rf"\[{section}\]\n(?:[^\n]+\n)+\n?", "", TEXT)
    assert found != TEXT
    return found


FAULTS = [
    ("listed, no section", _without("1005"), r"\[OptionalObjects\] \d+=0x1005: there is no section \[1005\]"),
    ("section, not listed", _edited("OptionalObjects", "1=0x1002\n", ""), r"\[1002\]: in none of the lists"),
    ("count of list", _edited("MandatoryObjects", "=3", "=4"), r"SupportedObjects=4: 3 objects are listed"),
    ("numbering", _edited("MandatoryObjects", "3=0x1018", "4=0x1018"), r"keys must count from 1 to 3"),
    ("twice", _edited("OptionalObjects", "1=0x1002", "1=0x1003"), r"0x1003: already listed"),
    ("wrong list", _edited("OptionalObjects", "1=0x1002", "1=0x2120"), r"belongs in \[ManufacturerObjects\]"),
    ("list value", _edited("MandatoryObjects", "0x1018", "abc"), r"3=abc: allowed is an index"),
    ("mandatory", _without("1001"), r"\[1001\]: the object is mandatory"),
    ("list missing", _without("MandatoryObjects"), r"\[MandatoryObjects\]: the section is missing"),
    ("sub missing", _without("1018sub4"), r"\[1018\] SubNumber=5: there are 4 sections"),
    ("sub 0 missing", _without("1018sub0"), r"\[1018\]: sub-index 0 is missing"),
    ("sub number", _edited("1018", "SubNumber=5", "SubNumber=6"), r"\[1018\] SubNumber=6: there are 5"),
    ("no sub number", _edited("1018", "\nSubNumber=5", ""), r"\[1018\] SubNumber missing"),
    ("orphan", _without("1018"), r"\[1018sub0\]: there is no section \[1018\]"),
    ("sub of a VAR", _edited("1018", "0x9", "0x7"), r"\[1018sub0\]: \[1018\] is no ARRAY or RECORD"),
    ("object type", _edited("1018", "0x9", "0xA"), r"\[1018\] ObjectType=0xA: allowed are"),
    ("entry type", _edited("1018sub1", "0x7", "0x9"), r"\[1018sub1\] ObjectType=0x9: an entry is"),
    ("data type", _edited("1018sub1", "0x0007", "0x00FF"), r"\[1018sub1\] DataType=0x00FF: not a data type"),
    ("no data type", _edited("1018sub1", "DataType=0x0007\n", ""), r"\[1018sub1\] DataType missing"),
    ("access", _edited("1017", "=rw", "=readwrite"), r"\[1017\] AccessType=readwrite: allowed are ro, wo"),
    ("default text", _edited("1017", "=1000", "=soon"), r"\[1017\] DefaultValue=soon: .*UNSIGNED16"),
    ("default size", _edited("1017", "=1000", "=70000"), r"70000 does not fit UNSIGNED16: .*0 to 65535"),
    ("signed hex", _edited("2122", "=-32768", "=0x8000"), r"32768 does not fit INTEGER16"),
    ("default high", _edited("1019", "DefaultValue=0", "DefaultValue=241"), r"\[1019\] DefaultValue=241: .*0 to 240"),
    (
        "real default",
        _edited("2105sub1", "=10000.0", "=0.5"),
        r"\[2105sub1\] DefaultValue=0.5: allowed are 1 to 1e\+30",
    ),
    ("limit", _edited("1019", "HighLimit=240", "HighLimit=x"), r"\[1019\] HighLimit=x: .*UNSIGNED8"),
    ("limits", _edited("1019", "LowLimit=0", "LowLimit=241"), r"\[1019\] LowLimit=241: above HighLimit=240"),
    ("node-id", _edited("1014", "$NODEID+0x80", "$NODEID+"), r"\[1014\] DefaultValue"),
    ("mappable", _edited("2121", "PDOMapping=1", "PDOMapping=2"), r"\[2121\] PDOMapping=2: allowed are 0 and 1"),
    ("mapped string", _edited("1008", "PDOMapping=0", "PDOMapping=1"), r"VISIBLE_STRING has no length"),
    ("not mappable", _edited("2120", "PDOMapping=1", "PDOMapping=0"), r"\[1A00sub4\].*\[2120\] is not mappable"),
    ("mapped nothing", _edited("1A00sub1", "0x71300110", "0x71307710"), r"there is no 0x7130:77"),
    ("mapped bits", _edited("1A00sub1", "0x71300110", "0x71300108"), r"8 bits, \[7130sub1\] has 16"),
    ("65 bits", _edited("1A00sub1", "0x71300110", "0x61300120"), r"\[1A00\]: the mapping has 80 bits"),
    ("mapped dummy", _edited("1A00sub1", "0x71300110", "0x00060010"), r"does not have Dummy0006=1"),
    ("direction", _edited("2120", "AccessType=ro", "AccessType=rww"), r"\[1A00sub4\].*\[2120\] is rww"),
    ("mapped count", _edited("1A00sub0", "DefaultValue=5", "DefaultValue=9"), r"\[1A00sub0\] DefaultValue=9"),
    ("mapping value", _edited("1600sub1", "0x21300010", "2130h"), r"\[1600sub1\] DefaultValue=2130h"),
    ("no mapping", _without("1600"), r"\[1400\]: its mapping \[1600\] is missing"),
    ("no parameters", _without("1400"), r"\[1600\]: its communication parameters \[1400\] are missing"),
    ("PDO count", _edited("DeviceInfo", "NrOfTXPDO=4", "NrOfTXPDO=3"), r"NrOfTXPDO=3: there are 4 such PDOs"),
    ("highest sub", _edited("1018sub0", "=4", "=3"), r"\[1018sub0\] DefaultValue=3: the highest sub-index is 4"),
    ("long name", _edited("1017", "Producer", "x" * 242), r"\[1017\] ParameterName=.*at most 241"),
    ("no name", _edited("1017", "=Producer heartbeat time", "="), r"\[1017\] ParameterName=: needed"),
    ("same name", _edited("1018sub2", "Product code", "Vendor-ID"), r"Vendor-ID: \[1018sub1\] has the same name"),
    ("same object name", _edited("2140", "Active", "Staged"), r"\[2140\] has the same name"),
    ("vendor", _edited("DeviceInfo", "VendorNumber=0x00000000", "VendorNumber="), r"VendorNumber=: .*blank"),
    ("product", _edited("DeviceInfo", "0x54500003", "0x54500004"), r"ProductNumber=0x54500004: \[1018sub2\]"),
    ("flag", _edited("DeviceInfo", "LSS_Supported=1", "LSS_Supported=yes"), r"LSS_Supported=yes: allowed are 0"),
    ("bit rate", _edited("DeviceInfo", "BaudRate_10=1", "BaudRate_10=2"), r"BaudRate_10=2: allowed are 0 and 1"),
    ("dummy", _edited("DummyUsage", "Dummy0007=0", ""), r"\[DummyUsage\] Dummy0007 missing: .*all seven"),
    ("no dummies", _without("DummyUsage"), r"\[DummyUsage\]: the section is missing"),
    ("comments", _edited("Comments", "Lines=3", "Lines=2"), r"\[Comments\] Lines=2: the section has 3"),
    ("date", _edited("FileInfo", "CreationDate=01-01-2025", "CreationDate=2025-01-01"), r"the form is mm-dd-yyyy"),
    ("time", _edited("FileInfo", "CreationTime=12:00AM", "CreationTime=24:00"), r"the form is hh:mmAM"),
    ("version", _edited("FileInfo", "EDSVersion=4.0", "EDSVersion=9"), r"EDSVersion=9: allowed are 3.0 and 4.0"),
    ("flags", _edited("2104", "ObjFlags=0x3", "ObjFlags=all"), r"\[2104\] ObjFlags=all"),
    ("unknown section", TEXT + "\n[Nonsense]\nA=1\n", r"\[Nonsense\]: not a section of CiA 306"),
    ("section twice", TEXT + "\n[1017]\nParameterName=x\n", r"line \d+: \[1017\]: the section is already there"),
    (
        "key twice",
        _edited("1017", "PDOMapping=0", "PDOMapping=0\nPDOMapping=1"),
        r"line \d+: \[1017\] PDOMapping: the key",
    ),
    ("no key", TEXT + "\njust words\n", r"line \d+: 'just words': allowed are"),
    ("no section", "A=1\n" + TEXT, r"line 1: 'A=1': a key needs a \[section\]"),
]


@pytest.mark.parametrize(("text", "said"), [fault[1:] for fault in FAULTS], ids=[fault[0] for fault in FAULTS])
def test_a_fault_is_named(text: str, said: str) -> None:
    complaints = lint_eds(text)
    assert any(re.search(said, complaint) for complaint in complaints), complaints
    assert len(complaints) < 15, complaints


def test_an_empty_file_says_what_is_missing() -> None:
    complaints = lint_eds("")
    for name in ("FileInfo", "DeviceInfo", "DummyUsage", "MandatoryObjects", "1000", "1018"):
        assert any(complaint.startswith(f"[{name}]") for complaint in complaints)


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.integers(0, TEXT.count("\n")), st.text(max_size=20))
def test_never_raises(line: int, junk: str) -> None:
    lines = TEXT.split("\n")
    lines[line : line + 1] = [junk]
    assert isinstance(lint_eds("\n".join(lines)), list)
