"""An EDS that is written here has no fault, and a fault that is put in is seen."""

from __future__ import annotations

import re

import pytest

from dictionary.eds_faults import eds_faults
from tipforce.dictionary.eds import eds_text

TEXT = eds_text(3)


@pytest.mark.parametrize(("n", "simulated"), [(n, s) for n in range(3, 9) for s in (False, True)])
def test_ours_is_clean(n: int, simulated: bool) -> None:
    assert eds_faults(eds_text(n, simulated)) == []


def test_comments_case_and_crlf_are_no_fault() -> None:
    text = "; a comment\n" + TEXT.replace("[2105sub1]", "[2105SUB1]").replace("SubNumber", "SUBNUMBER")
    assert eds_faults(text.replace("\n", "\r\n")) == []


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
    ("section, not listed", _edited("OptionalObjects", "1=0x1002\n", "")),
    ("numbering", _edited("MandatoryObjects", "3=0x1018", "4=0x1018")),
    ("sub missing", _without("1018sub4")),
    ("default size", _edited("1017", "=1000", "=70000")),
    ("mappable", _edited("2121", "PDOMapping=1", "PDOMapping=2")),
    ("not mappable", _edited("2120", "PDOMapping=1", "PDOMapping=0")),
    ("mapped bits", _edited("1A00sub1", "0x71300110", "0x71300108")),
    ("direction", _edited("2120", "AccessType=ro", "AccessType=rww")),
    ("PDO count", _edited("DeviceInfo", "NrOfTXPDO=4", "NrOfTXPDO=3")),
    ("same name", _edited("1018sub2", "Product code", "Vendor-ID")),
    ("same object name", _edited("2140", "Active", "Staged")),
    ("vendor", _edited("DeviceInfo", "VendorNumber=0x00000000", "VendorNumber=")),
    ("product", _edited("DeviceInfo", "0x54500003", "0x54500004")),
    ("dummy", _edited("DummyUsage", "Dummy0007=0", "")),
    ("comments", _edited("Comments", "Lines=3", "Lines=2")),
    ("date", _edited("FileInfo", "CreationDate=01-01-2025", "CreationDate=2025-01-01")),
    ("time", _edited("FileInfo", "CreationTime=12:00AM", "CreationTime=24:00")),
    ("version", _edited("FileInfo", "EDSVersion=4.0", "EDSVersion=9")),
    ("unknown section", TEXT + "\n[Nonsense]\nA=1\n"),
    ("section twice", TEXT + "\n[1017]\nParameterName=x\n"),
]


@pytest.mark.parametrize("text", [fault[1] for fault in FAULTS], ids=[fault[0] for fault in FAULTS])
def test_a_fault_is_seen(text: str) -> None:
    assert eds_faults(text)
