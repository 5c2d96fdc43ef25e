"""`tipforce export c` and `export dcf`, and what CANopenEditor's reader asks of our EDS and DCF."""

import io
import re
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import canopen
import pytest

from canopen_device.eds import read_eds
from tipforce.dictionary.eds import dcf_text, eds_text
from tipforce.dictionary.table import CONVERTER_24
from tipforce.host.configuration.configuration_file import read_configuration
from tipforce_tools.cli.main import main
from tipforce_tools.export_c.files import c_files

Export = Callable[..., tuple[int, str, str]]


@pytest.fixture
def export(capsys: pytest.CaptureFixture[str]) -> Export:
    def run(*words: object) -> tuple[int, str, str]:
        return (main(["export", *(str(word) for word in words)]), *capsys.readouterr())

    return run


def test_export_c(export: Export, tmp_path: Path) -> None:
    code, out, err = export("c", "--gauges", 4, "--bits", 24, "-o", tmp_path / "made" / "here")
    assert (code, out) == (0, "")
    written = {path.name: path.read_text() for path in (tmp_path / "made/here").iterdir()}
    assert written == c_files(4, CONVERTER_24)
    assert "#define TIPFORCE_GAUGES 4" in written["tipforce_od.h"]
    assert len(err.splitlines()) == len(written)


def test_export_c_that_cannot_be(export: Export, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for words, message in (
        (["c"], "--output: `export c` writes several files; name a folder"),
        (["c", "-o", tmp_path / "file"], f"--output {tmp_path / 'file'}: is a file; name a directory"),
        (["c", "--gauges", 2, "-o", tmp_path / "x"], "number of gauges: 2"),
        (["dcf"], "--node-id: a DCF belongs to one node; add it, for example --node-id 5"),
        (["dcf", "--node-id", 5, "--settings", tmp_path / "absent.toml"], "absent.toml: No such file"),
    ):
        code, out, err = export(*words)
        assert (code, out) == (2, "")
        assert message in err


SETTINGS = """
[objects]
"heartbeat.producer_ms" = 250
"contact.on_force" = 0.125
"tpdo4.cob_id" = 0x40000485
"""


def test_export_dcf(export: Export, tmp_path: Path) -> None:
    assert export("dcf", "--node-id", "0x0A") == (0, dcf_text(3, 10, {}), "")
    settings, dcf = tmp_path / "settings.toml", tmp_path / "node.dcf"
    settings.write_text(SETTINGS)
    assert export("dcf", "--node-id", 5, "--settings", settings, "-o", dcf)[0] == 0
    assert read_eds(dcf).warnings == []
    # Back to the same configuration, by canopen's own reader, and from the DCF to a DCF.
    wanted = read_configuration(settings, 5)
    assert read_configuration(dcf, 5) == wanted
    assert export("dcf", "--node-id", 5, "--settings", dcf)[1] == dcf.read_text()
    heartbeat = canopen.import_od(str(dcf), 5)[0x1017]
    assert isinstance(heartbeat, canopen.objectdictionary.ODVariable)
    assert heartbeat.value == 250


# --- CANopenEditor --------------------------------------------------------------------------------------------------
# What its reader (libEDSsharp, CanOpenEDS.cs) does with a file, where that can make it refuse, warn or lose something.

SECTION = re.compile(r"^\[([a-z0-9]+)\]", re.IGNORECASE)
KEY = re.compile(r"^([a-z0-9_]+)[ ]*=[ ]*(.*)", re.IGNORECASE)
ENTRY = re.compile(r"^(M[0-9a-fA-F]+(Fixed|SubExt))?([a-fA-F0-9]+)(sub)?([0-9a-fA-F]*)$")
ACCESS = {"rw", "ro", "wo", "rwr", "rww", "const"}
UNSIGNED = {
    "VendorNumber": 32, "ProductNumber": 32, "RevisionNumber": 32, "NrOfRXPDO": 16, "NrOfTXPDO": 16, "Granularity": 8,
    "FileVersion": 8, "FileRevision": 8, "NodeID": 8, "Baudrate": 16, "NetNumber": 32, "LSS_SerialNumber": 32,
}  # fmt: skip


def number(text: str, bits: int = 16) -> int:
    """As it converts: 0x is hexadecimal, a leading zero octal; beyond the size it fails."""
    base = 16 if text.startswith("0x") else 8 if re.match(r"^0[1-7]+", text) else 10
    found = int(text, base)
    assert 0 <= found < 1 << bits, text
    return found


def sections(text: str) -> dict[str, dict[str, str]]:
    """Sections and keys in any case count as written: they are looked up by their exact name."""
    found: dict[str, dict[str, str]] = {}
    name = ""
    for line in filter(None, text.splitlines()):
        assert line[0] != ";"
        if match := SECTION.match(line):
            name = match[1]
            assert name not in found, f"duplicate section [{name}]"
            found[name] = {}
        else:
            match = KEY.match(line)
            assert match, line
            assert match[1] not in found[name], f"duplicate key {match[1]} in [{name}]"
            found[name][match[1]] = match[2].strip()
    return found


def read_as_canopeneditor(text: str) -> dict[int, set[int]]:
    """Sub-indices by index (none for a VAR); AssertionError, KeyError or ValueError where it would fail or warn."""
    eds = sections(text)
    info = eds["FileInfo"]
    for what in ("Creation", "Modification"):
        datetime.strptime(f"{info[what + 'Time'].replace(' ', '')} {info[what + 'Date']}", "%I:%M%p %m-%d-%Y")
    assert [number(part, 8) for part in info["EDSVersion"].split(".")] == [4, 0]
    for part in ("FileInfo", "DeviceInfo", "DeviceComissioning"):
        present = eds.get(part, {}) if part == "DeviceComissioning" else eds[part]
        for key, bits in UNSIGNED.items():
            if key in present:
                number(eds[part][key], bits)
    found: dict[int, set[int]] = {}
    for name, keys in eds.items():
        match = ENTRY.match(name)
        if match is None:
            continue
        assert not match[1], f"[{name}] would be taken for a module's"
        _entry(int(match[3], 16), match[5], keys, found)
    listed = [eds[f"{kind}Objects"] for kind in ("Mandatory", "Optional", "Manufacturer")]
    indices = [number(value) for each in listed for key, value in each.items() if key != "SupportedObjects"]
    assert all(number(each["SupportedObjects"]) == len(each) - 1 for each in listed)
    assert sorted(indices) == sorted(found)
    return found


def _entry(index: int, sub: str, keys: dict[str, str], found: dict[int, set[int]]) -> None:
    assert keys["ParameterName"]
    kind = number(keys["ObjectType"])
    assert kind in (7, 8, 9)
    if "ObjFlags" in keys:
        number(keys["ObjFlags"], 32)
    if kind == 7:
        assert number(keys["DataType"]) in range(1, 0x1C)
        assert keys["AccessType"].lower() in ACCESS
        assert number(keys["PDOMapping"]) in (0, 1)
        assert "DefaultValue" in keys
    else:
        assert not sub
        number(keys["SubNumber"], 8)
    if sub:
        found[index].add(int(sub, 16))  # KeyError: the object must come before its entries
    else:
        assert index not in found
        found[index] = set()


@pytest.mark.parametrize("text", [
    eds_text(3), eds_text(8, converter=CONVERTER_24), eds_text(3, simulated=True),
    dcf_text(3, 5, {(0x1017, 0): 250}), dcf_text(4, 127, {}),
])  # fmt: skip
def test_canopeneditor_reads_all_of_it(text: str) -> None:
    found = read_as_canopeneditor(text)
    file = io.StringIO(text)
    file.name = "text.eds"
    od = canopen.import_od(file, 5)
    assert {index: _subs(od[index]) for index in od} == found


def _subs(found: object) -> set[int]:
    return (
        set(found) if isinstance(found, canopen.objectdictionary.ODRecord | canopen.objectdictionary.ODArray) else set()
    )


@pytest.mark.parametrize(("before", "after"), [
    ("ParameterName=Device type\n", ""), ("AccessType=ro", "AccessType=r"), ("SubNumber=5", "SubNumber=0x"),
    ("[1018]", "[1018"), ("CreationTime=12:00AM", "CreationTime=24:00"), ("[DeviceInfo]", "[deviceinfo]x"),
])  # fmt: skip
def test_the_check_can_fail(before: str, after: str) -> None:
    text = eds_text(3)
    assert before in text
    with pytest.raises((AssertionError, KeyError, ValueError)):
        read_as_canopeneditor(text.replace(before, after, 1))
