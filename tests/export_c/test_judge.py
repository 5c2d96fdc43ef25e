"""`tipforce export c`: what it writes; the C judge gives the status bits of the Python one."""

import configparser
import io
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import canopen
import numpy as np
import pytest

from export_c.estimators import OPAQUE_BYTES, Library
from host.decoding.test_judged import BITS, recorded
from tipforce.dictionary import table
from tipforce.dictionary.eds import dcf_text, eds_text
from tipforce.dictionary.table import CONVERTER_24
from tipforce.fingertip import judgement
from tipforce.fingertip.sample import Sample
from tipforce.host.configuration.calibration import Calibration
from tipforce.host.configuration.configuration_file import read_configuration
from tipforce.sensor.contact import scalar, scalar_redundancy
from tipforce_tools.cli.main import main
from tipforce_tools.export import c_files

Libraries = Callable[[int, str], Library]
CALIBRATED, UNKNOWN_FORCE = 0x02, 1
VERDICT = np.dtype(
    [("faults", "u2"), ("early", "u1"), ("determined", "?"), ("overloaded", "?"), ("more", "u1", OPAQUE_BYTES)]
)
BAND_CHI_SQUARE, BAND_FORCE = 1e-3, 1e-5
"""Relative: within it single precision may decide otherwise (docs/uncertainty.md)."""

SETTINGS = """
[objects]
"heartbeat.producer_ms" = 250
"contact.on_force" = 0.125
"tpdo4.cob_id" = 0x40000485
"""
KEY = re.compile(r"[a-z0-9_]+", re.IGNORECASE)
ENTRY = re.compile(r"^(M[0-9a-fA-F]+(Fixed|SubExt))?([a-fA-F0-9]+)(sub)?([0-9a-fA-F]*)$")
ACCESS = {"rw", "ro", "wo", "rwr", "rww", "const"}
UNSIGNED = {
    "VendorNumber": 32, "ProductNumber": 32, "RevisionNumber": 32, "NrOfRXPDO": 16, "NrOfTXPDO": 16, "Granularity": 8,
    "FileVersion": 8, "FileRevision": 8, "NodeID": 8, "Baudrate": 16, "NetNumber": 32, "LSS_SerialNumber": 32,
}  # fmt: skip


def test_constants_of_the_c_sources_are_those_of_python() -> None:
    """Each that both name: scalar, numpy and C judge by one set."""
    text = "\n".join(c_files(4).values())
    number = r"(0[xX][0-9A-Fa-f]+|\d[\d.]*(?:[eE]-?\d+)?)"
    in_c = re.findall(rf"#define (?:TIPFORCE_)?(\w+) (?:\(\(real\))?{number}\)?(?=\s|$)", text, re.MULTILINE)
    in_c += re.findall(rf"^    TIPFORCE_(\w+) = {number}", text, re.MULTILINE)
    known = {name: value for module in (scalar, scalar_redundancy, judgement) for name, value in vars(module).items()}
    known |= {name: 1 << bit for name, bit in vars(table).items() if name.startswith("FAULT_") and isinstance(bit, int)}
    known |= {name.removeprefix("_"): value for name, value in known.items()}
    both = [(name, float(int(text, 0)) if "x" in text else float(text)) for name, text in in_c if name in known]
    assert {name for name, _ in both} >= {
        "NO_FAULT", "LEAST_SHARE", "RELEASE", "UNSTATED_KELVIN", "SMALLEST_PIVOT", "SMALLEST_VARIANCE",
        "CONDITION_LIMIT", "THETA_RESOLVED_DEG", "MISS_FLOOR", "PAD_SLACK_DEG", "UNKNOWN_THETA", "OUTSIDE_PAD",
        "FAULT_OVERLOAD",
    }  # fmt: skip
    assert [pair for pair in both if pair[1] != known[pair[0]]] == []


def judged(library: Library, of: Calibration, samples: list[Sample]) -> list[tuple[int, int, float, float]]:
    """(2124h, status byte, P, u(P)) of each sample as the C code gives them."""
    record = np.concatenate([
        of.C.ravel(), of.offset_strain, of.covariance_strain2[np.triu_indices(of.gauges)],
        [of.reference_temperature_degC, of.calibrated_force_newtons, of.overload_force_newtons],
        [of.temperature_min_degC, of.temperature_max_degC, of.model_uncertainty],
        of.converter_limit_strain, of.offset_temperature_strain_per_K, [of.gain_temperature_per_K],
        [of.redundancy_limit],
    ])  # fmt: skip
    limits = np.zeros(1, library.calibration)
    limits[["on_N", "off_N", "theta_min_deg", "theta_max_deg", "pull"]] = [
        (of.contact_on_newtons, of.contact_off_newtons, of.theta_min_deg, of.theta_max_deg, of.pull)
    ]
    judge, tare = np.zeros(OPAQUE_BYTES, "u1"), np.zeros(3, library.dtype)
    verdicts, results = np.zeros(1, VERDICT), np.zeros(1, library.result)
    library("judge_setup", judge, record)
    verdict, result = verdicts[0], results[0]
    found, overloaded, present = [], False, False
    for sample in samples:
        assert sample.reading is not None
        strain = np.array(sample.microstrains, library.dtype) * 1e-6
        celsius = math.nan if sample.reading.temperature == -0x8000 else sample.reading.temperature / 100
        lost = sum(1 << k for k, over in enumerate(sample.overloads) if over)
        library("judge_sample", judge, strain, library.real(celsius), lost, overloaded, verdicts)
        library("judge_estimate", verdicts, limits, tare, CALIBRATED, present, results)
        overloaded = bool(verdict["overloaded"])
        present = bool(result["status"] & 1) if not math.isnan(result["P"]) else present
        found.append((int(verdict["faults"]), int(result["status"]), float(result["P"]), float(result["u_P"])))
    return found


@pytest.mark.parametrize("n", [3, 4, 5, 6, 8])
@pytest.mark.parametrize("real", ["double", "float"])
def test_the_verdicts_of_c_and_node_are_equal(n: int, real: str, library: Libraries) -> None:
    calibration, samples = recorded(n)
    found = judged(library(n, real), calibration, samples)
    node = [(s.faults & BITS, s.status()) for s in samples]
    other = [k for k, (mine, theirs) in enumerate(zip(found, node, strict=True)) if mine[:2] != theirs]
    if real == "double":
        assert other == []
    else:
        assert len(other) <= len(samples) * 0.005, [(k, found[k], node[k]) for k in other]
    rel = 1e-9 if real == "double" else 2e-3
    for k, (sample, one) in enumerate(zip(samples, found, strict=True)):
        if k in other:
            continue
        hidden = bool(sample.unknown() & UNKNOWN_FORCE)
        assert math.isnan(one[2]) == hidden
        if not hidden:
            assert one[2] == pytest.approx(sample.contact()[0], rel=rel, abs=1e-6)
            assert one[3] == pytest.approx(sample.uncertainty()[0], rel=max(rel, 1e-6))


@pytest.mark.parametrize("noise", [1e-12, 0.0])
def test_what_a_lost_gauge_reads_changes_nothing(noise: float, library: Libraries) -> None:
    calibration, samples = recorded(5)
    rest, found = samples[50].microstrains[1:], []
    for read in (0.0, math.nan, math.inf):
        one: Any = SimpleNamespace(reading=samples[50].reading, overloads=[1, 0, 0, 0, 0], microstrains=[read, *rest])
        found += judged(library(5, "double"), replace(calibration, covariance_strain2=noise * np.eye(5)), [one])
    assert found[0][:2] == (0x0001, 0x07)
    assert found == 3 * found[:1]


def test_float_and_double_differ_only_in_a_band_around_a_limit(library: Libraries) -> None:
    """The limit is put beside a sample's own chi-square, and the calibrated force beside its own P."""
    calibration, samples = recorded(5)
    in_double, in_single = library(5, "double"), library(5, "float")
    chosen = [samples[k] for k in range(105, len(samples), 48) if samples[k].solver is not None]
    assert len(chosen) > 4
    for sample in chosen:
        P = math.hypot(*sample.force()[::2])  # the load is at the tip: F2 is small
        low, high = 0.0, 1e3
        while high - low > 1e-6 * high:  # chi-square of the sample, by the verdict of the double variant
            limit = 0.5 * (low + high)
            one = replace(calibration, redundancy_limit=limit)
            contradicts = judged(in_double, one, [sample])[0][0] >> 12 & 1
            low, high = (limit, high) if contradicts else (low, limit)
        for side in (-1, 1):
            one = replace(
                calibration,
                redundancy_limit=high * (1.0 + side * BAND_CHI_SQUARE),
                calibrated_force_newtons=P * (1.0 + side * BAND_FORCE),
            )
            double, single = (judged(variant, one, [sample])[0] for variant in (in_double, in_single))
            assert single[:2] == double[:2]
            assert double[0] >> 12 & 1 == (side < 0)


def test_export_c(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "made" / "here"
    assert main(["export", "c", "--gauges", "4", "--bits", "24", "-o", str(folder)]) == 0
    out, err = capsys.readouterr()
    written = {path.name: path.read_text() for path in folder.iterdir()}
    assert (out, written) == ("", c_files(4, CONVERTER_24))
    assert "#define TIPFORCE_GAUGES 4" in written["tipforce_od.h"]
    assert len(err.splitlines()) == len(written)


def test_export_dcf(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    export, settings, dcf = ["export", "dcf", "--node-id"], tmp_path / "settings.toml", tmp_path / "node.dcf"
    assert main([*export, "0x0A"]) == 0
    assert capsys.readouterr() == (dcf_text(3, 10, {}), "")
    settings.write_text(SETTINGS)
    assert main([*export, "5", "--settings", str(settings), "-o", str(dcf)]) == 0
    assert read_configuration(dcf, 5) == read_configuration(settings, 5)
    assert main([*export, "5", "--settings", str(dcf)]) == 0
    assert capsys.readouterr().out == dcf.read_text()


# What its reader (libEDSsharp, CanOpenEDS.cs) does with a file, where that can make it refuse, warn or lose something.


def number(text: str, bits: int = 16) -> int:
    """As it converts: 0x is hexadecimal, a leading zero octal; beyond the size it fails."""
    found = int(text, 16 if text.startswith("0x") else 8 if re.match(r"^0[1-7]+", text) else 10)
    assert 0 <= found < 1 << bits, text
    return found


def sections(text: str) -> Any:
    """Sections and keys in any case count as written: they are looked up by their exact name."""
    found: Any = configparser.ConfigParser(delimiters="=", comment_prefixes=(), interpolation=None)
    found.optionxform = str
    found.read_string(text)
    assert all(KEY.fullmatch(key) for keys in found.values() for key in keys)
    return found


def read_as_canopeneditor(text: str) -> dict[int, set[int]]:
    """Sub-indices by index (none for a VAR); AssertionError, KeyError or ValueError where it would fail or warn."""
    eds = sections(text)
    info = eds["FileInfo"]
    for what in ("Creation", "Modification"):
        datetime.strptime(f"{info[what + 'Time'].replace(' ', '')} {info[what + 'Date']}", "%I:%M%p %m-%d-%Y")
    assert [number(part, 8) for part in info["EDSVersion"].split(".")] == [4, 0]
    for part in ("FileInfo", "DeviceInfo", "DeviceComissioning"):
        present = eds[part] if part in eds or part != "DeviceComissioning" else {}
        for key in UNSIGNED.keys() & present.keys():
            number(present[key], UNSIGNED[key])
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


def _entry(index: int, sub: str, keys: Mapping[str, str], found: dict[int, set[int]]) -> None:
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
    od: Any = canopen.import_od(file, 5)
    variable = canopen.objectdictionary.ODVariable
    assert {index: set() if isinstance(od[index], variable) else set(od[index]) for index in od} == found


@pytest.mark.parametrize(("before", "after"), [
    ("ParameterName=Device type\n", ""), ("AccessType=ro", "AccessType=r"), ("SubNumber=5", "SubNumber=0x"),
    ("[1018]", "[1018"), ("CreationTime=12:00AM", "CreationTime=24:00"), ("[DeviceInfo]", "[deviceinfo]x"),
])  # fmt: skip
def test_the_check_can_fail(before: str, after: str) -> None:
    text = eds_text(3)
    assert before in text
    with pytest.raises((AssertionError, KeyError, ValueError, configparser.Error)):
        read_as_canopeneditor(text.replace(before, after, 1))
