"""Hostile device files: each is refused, or read, in work that its limits bound; work is calls and bytes, not time."""

import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from canopen_device.eds import Description, description, reader, sections
from canopen_device.eds import xdd as xdd_module
from canopen_device.eds.dcf import dcf_text
from canopen_device.eds.load import device_of
from canopen_device.eds.xdd import DEEPEST
from canopen_device.errors import InputError
from canopen_device.types import TYPES
from eds.samples import INFO, MANDATORY, described, record, text, var
from tipforce.host.decoding.pdo_layout import dcf_layout

ENTRIES, LINES, FINDINGS, CHARACTERS, LONGEST = 1000, 10_000, 1000, 400_000, 4096
CALLS, PEAK_BYTES = 600_000, 24 << 20
"""Of the largest file within these limits; real limits are about a hundred times as large."""

COMPACT = "ParameterName=x\nObjectType=8\nDataType={kind}\nAccessType=rw\nCompactSubObj=254\n"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits at which a test is fast."""
    for module, name, value in (
        (description, "MOST_ENTRIES", ENTRIES), (description, "MOST_VALUE_BYTES", CHARACTERS),
        (sections, "MOST_LINES", LINES), (sections, "MOST_FINDINGS", FINDINGS), (sections, "LONGEST_TEXT", LONGEST),
        (sections, "MOST_CHARACTERS", CHARACTERS), (xdd_module, "MOST_LINES", LINES),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)


@contextmanager
def bounded_work() -> Iterator[None]:
    """Fail when the block makes more calls or has more memory than the limits need."""
    calls = 0

    def count(_frame: object, event: str, _argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")
        if calls > CALLS:
            sys.setprofile(None)
            raise AssertionError(f"more than {CALLS} calls")

    tracemalloc.start()
    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(None)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < PEAK_BYTES


def compact(count: int, kind: int, default: str = "", first: int = 0x2000) -> str:
    """Objects of 254 entries each."""
    default = f"DefaultValue={default}\n" if default else ""
    return "".join(f"[{first + k:04X}]\n{COMPACT.format(kind=kind)}{default}" for k in range(count))


def xdd(body: str, before: str = "") -> str:
    return f"<?xml version='1.0'?>{before}\n<ISO15745ProfileContainer>\n{body}\n</ISO15745ProfileContainer>\n"


def references(count: int, value: str) -> str:
    """Objects that all refer to one parameter."""
    parameter = f"<parameter uniqueID='A' access='read'><defaultValue value='{value}'/></parameter>"
    return parameter + "".join(
        f"<CANopenObject index='{0x2000 + k:04X}' name='x' objectType='7' dataType='0009' uniqueIDRef='A'/>\n"
        for k in range(count)
    )


def listing(count: int) -> str:
    """A list of entries that do not exist, with a count of its own."""
    return "NrOfEntries=4000000000\n" + "".join(f"{k}=1\n" for k in range(1, count))


REFUSED = {
    "entries of compact arrays": ("eds", text(compact(20, 5)), rf"any\.eds:\d+: 0x2003:.*more than {ENTRIES} entries"),
    "entries of compact PDOs": (
        "eds", text().replace("[DeviceInfo]", "[DeviceInfo]\nCompactPDO=0x3F\nGranularity=1\nNrOfTXPDO=512"),
        rf"any\.eds:\d+: 0x1A0D:.*more than {ENTRIES} entries",
    ),
    "entries of sections": (
        "eds", text(*(record(f"{0x2000 + k:04X}", *(var(f"{0x2000 + k:04X}sub{j}", 5) for j in range(9)))
                      for k in range(120))),
        rf"more than {ENTRIES} entries",
    ),
    "lines": ("eds", text("; \n" * LINES), rf"any\.eds:\d+: \d+ lines; allowed are {LINES}"),
    "remarks": ("eds", text("nonsense\n" * 2 * FINDINGS), rf"any\.eds:\d+: {FINDINGS} remarks"),
    "remarks on lists": ("eds", text(compact(1, 5) + "[2000Value]\n" + listing(3000)), f"{FINDINGS} remarks"),
    "a long value": ("eds", text(var("2000", 9, default="x" * (LONGEST + 1))), f"characters; allowed are {LONGEST}"),
    "long values in compact arrays": (
        "eds", text(compact(3, 9, "x" * LONGEST)), rf"0x2000:.*more than {CHARACTERS} bytes of names and values"
    ),
    "domains in compact arrays": (
        "eds", text(compact(3, 0xF, "00" * (LONGEST // 2))), f"more than {CHARACTERS} bytes of names and values"
    ),
    "text of the whole file": (
        "eds", text(*(var(f"{0x2000 + k:04X}", 9, default="x" * LONGEST) for k in range(120))),
        f"more than {CHARACTERS} characters",
    ),
    "entities": (
        "xdd", xdd("&b;", "<!DOCTYPE a [<!ENTITY a 'xxxx'><!ENTITY b '&a;&a;&a;&a;'>]>"), r"a\.xdd:1: .*DOCTYPE"
    ),
    "depth": ("xdd", xdd("<a>" * 5000 + "</a>" * 5000), r"a\.xdd:3: elements in more than 64 levels"),
    "elements": ("xdd", xdd("<CANopenObject/>\n" * 2 * LINES), f"more than {LINES} elements"),
    "attributes": (
        "xdd", xdd("<CANopenObject " + " ".join(f"a{k}=''" for k in range(5000)) + "/>"), "with 5000 attributes"
    ),
    "a long attribute": (
        "xdd", xdd(f"<CANopenObject index='2000' name='{'x' * (LONGEST + 1)}'/>"), f"allowed are {LONGEST}"
    ),
    "a long element": ("xdd", xdd("<vendorName>" + "a<!---->" * 5000 + "</vendorName>"), "more than 255 characters"),
    "references to a long parameter": ("xdd", xdd(references(900, "x" * LONGEST)), f"more than {CHARACTERS}"),
    "references to lines": ("xdd", xdd(references(900, "x&#10;" * (LONGEST // 3))), f"more than {CHARACTERS}"),
}  # fmt: skip


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", REFUSED)
def test_a_hostile_file_is_refused_in_bounded_work(name: str, tmp_path: Path) -> None:
    kind, content, message = REFUSED[name]
    with bounded_work(), pytest.raises(InputError, match=message) as refused:
        described(tmp_path, content, name={"eds": "any.eds", "xdd": "a.xdd"}[kind])
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300


def sum_of(count: int) -> str:
    return "+".join(["$NODEID", *"1" * count])


ODD: dict[str, tuple[str, Callable[[Description], object], object]] = {
    "a long number": (text(var("2000", 7, default="9" * LONGEST)), lambda found: found.find(0x2000).default, 0),
    "a long sum": (text(var("2000", 7, default=sum_of(LONGEST // 2 - 4))), lambda found: found.find(0x2000).default, 0),
    "blanks before a word": (
        text(var("2000", 7, default="1" + " " * (LONGEST - 3) + "2")), lambda found: found.find(0x2000).default, 0
    ),
    "counts of lists": (
        INFO + MANDATORY + "[OptionalObjects]\nSupportedObjects=4294967295\n" + compact(1, 5)
        + "[2000Value]\nNrOfEntries=4294967295\n1=7\n0x2=9\n",
        lambda found: [found.find((0x2000, sub)).default for sub in (1, 2)], [7, 9],
    ),
    "long lists of a compact array": (
        text(compact(1, 5) + "".join(f"[2000{kind}]\n{listing(250)}" for kind in ("Name", "Value", "Denotation"))),
        lambda found: (found.find((0x2000, 249)).default, found.find((0x2000, 250)).default), (1, 0),
    ),
    "a count of PDOs": (
        text().replace("[DeviceInfo]", "[DeviceInfo]\nNrOfTXPDO=4294967295\nCompactPDO=0x3F"),
        lambda found: 0x1800 in found.objects, False,
    ),
    "a long name": (
        text(var("2000", 5, ParameterName="x" * LONGEST)), lambda found: len(found.objects[0x2000].name), 255
    ),
}  # fmt: skip


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", ODD)
def test_a_hostile_value_is_read_in_bounded_work(name: str, tmp_path: Path) -> None:
    content, look, expected = ODD[name]
    with bounded_work():
        found = described(tmp_path, content)
        device_of(found)
        dcf_text(found, {})
    assert look(found) == expected
    assert found.warnings


def test_files_of_domains_are_read_up_to_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A DCF may name one file for each DOMAIN; only a DOMAIN has one."""
    read = 0

    def content(eds: Path, name: str) -> tuple[bytes | None, str]:
        nonlocal read
        read += 1
        return file_content(eds, name)

    file_content = reader.file_content
    monkeypatch.setattr("canopen_device.eds.reader.file_content", content)
    monkeypatch.setattr(description, "MOST_VALUE_BYTES", 1 << 20)
    (tmp_path / "large.bin").write_bytes(bytes(1 << 18))
    entries = [var(f"{0x2000 + k:04X}", 0xF, UploadFile="large.bin") for k in range(50)]
    with pytest.raises(InputError, match=r"0x2003:00: more than 1048576 bytes of names and values"):
        described(tmp_path, text(*entries))
    assert read == 4
    described(tmp_path, text(*(var(f"{0x2000 + k:04X}", 7, UploadFile="large.bin") for k in range(50))))
    assert read == 4


def test_a_count_of_mapped_objects_is_not_counted_to(tmp_path: Path) -> None:
    path = tmp_path / "node.dcf"
    eds = (Path(__file__).parents[2] / "eds" / "tipforce-3.eds").read_text()
    mapping = eds.index("DefaultValue=", eds.index("[1A00sub0]"))
    path.write_text(eds[:mapping] + "DefaultValue=4294967295\n" + eds[eds.index("\n", mapping) + 1 :])
    with bounded_work(), pytest.raises(InputError, match=r"0x1A00:00 = 4294967295: allowed are 0 to 64 mapped"):
        dcf_layout(path, 5)


def test_the_largest_file_within_the_limits_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a tenth of the limit of entries, and at the other limits themselves."""
    monkeypatch.setattr(description, "MOST_ENTRIES", description.MOST_ENTRIES // 10)
    arrays = (description.MOST_ENTRIES - 6) // 255
    assert len(described(tmp_path, text(compact(arrays, 5))).entries()) == 255 * arrays + 4
    plain = described(tmp_path, text(*(var(f"{0x2000 + k:04X}", 7, default="0x1") for k in range(2000))))
    assert len(plain.objects) == 2003
    value = "x" * (sections.LONGEST_TEXT - 1)
    assert described(tmp_path, text(var("2000", 9, default=value))).find(0x2000).default == value
    nested = "<a>" * (DEEPEST - 1) + "</a>" * (DEEPEST - 1)
    assert len(described(tmp_path, xdd(references(3, "7") + nested), name="a.xdd").objects) == 6


def test_two_megabytes_do_not_make_millions_of_entries(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"more than 100000 entries, the limit"):
        described(tmp_path, INFO + MANDATORY + compact(0x4000, 5))


@pytest.mark.parametrize("code", sorted({kind.code for kind in TYPES.values()}))
def test_a_parameter_value_without_a_default_is_the_default_of_an_eds(code: int, tmp_path: Path) -> None:
    """As editors of Yiyou, Kollmorgen and Technosoft write it."""
    kind = next(kind for kind in TYPES.values() if kind.code == code)
    shown = {str: "text", bytes: "01" * (kind.size or 3), float: "1.5"}.get(kind.python, "1")
    written = text(var("2000", code, "rw", "", ParameterValue=shown), var("2001", code, "rw", shown))
    found = described(tmp_path, written)
    first, second = found.find(0x2000), found.find(0x2001)
    assert (first.default, first.initial, first.has_default, first.value) == (
        second.default, second.initial, True, None,
    )  # fmt: skip
    assert "where there is none (1) the ParameterValue" in " ".join(found.warnings)
    stored = described(tmp_path, dcf_text(found, {(0x2001, 0): second.default}), None, "saved.dcf")
    assert (stored.find(0x2000).default, stored.find(0x2001).value) == (first.default, second.default)
