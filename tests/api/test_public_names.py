"""The front doors: public names, lazy and typed; hands row by row, logs as arrays, calibrations, estimates."""

import ast
import compileall
import importlib
import itertools
import math
import pkgutil
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import tipforce
from tipforce.host import write_calibration
from tipforce.scene import beam_calibration
from tipforce.sensor import FABRICATED, calibration_matrix, force_vector, strain_matrix
from tipforce.shipped_files import shipped_folder
from tipforce_tools.cli.main import main

ROOT = Path(__file__).parents[2]
DICTIONARY = ROOT / "node" / "tipforce" / "dictionary"
PARTS = ["host", "sensor", "fingertip", "sources", "scene"]
DEVICE = ["canopen_device", *(f"canopen_device.{part}" for part in ("eds", "machine", "running"))]
ROBOTS = ["tipforce_robots.mujoco", "tipforce_robots.learning"]
PACKAGES = ["tipforce", *(f"tipforce.{part}" for part in PARTS), *DEVICE, *ROBOTS]
OWN = ("tipforce", "canopen_device")
TOOLS = ["tipforce_lab", "tipforce_lab.fem"]  # an extra of its own
DOCUMENTS = sorted([ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("docs/examples/*.py")])


def python(code: str, *flags: str) -> str:
    done = subprocess.run([sys.executable, *flags, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("package", [*PACKAGES, *TOOLS])
def test_every_public_name_is_there_and_has_a_docstring(package: str) -> None:
    module = importlib.import_module(package)
    assert len(set(module.__all__)) == len(module.__all__)
    assert not {info.name for info in pkgutil.iter_modules(module.__path__)} & set(module.__all__)
    for name in module.__all__:
        found = getattr(module, name)
        if callable(found):
            assert found.__doc__, f"{package}.{name}"
    with pytest.raises(AttributeError):
        _ = module.nothing_of_this_name


def test_a_bare_environment_is_enough_to_import_it() -> None:
    """No site-packages: neither numpy nor python-can is there."""
    code = f"import sys; sys.path.insert(0, {str(ROOT / 'node')!r}); import tipforce; "
    code += "print(tipforce.__version__, len(tipforce.__all__), sorted(dir(tipforce)) == sorted(tipforce.__all__))"
    version, count, same = python(code, "-S", "-I").split()
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert int(count) == 32
    assert same == "True"


def test_importing_it_loads_nothing_of_others() -> None:
    modules = ["tipforce", "tipforce.host", "tipforce.sensor", "tipforce.scene", "canopen_device", *ROBOTS]
    modules += ["canopen_device.core", *(f"tipforce.dictionary.{path.stem}" for path in DICTIONARY.glob("[a-z]*.py"))]
    code = f"import sys, importlib\nfor name in {modules}: importlib.import_module(name)\n"
    code += "others = {'numpy', 'can', 'canopen', 'cantools', 'msgspec', 'scipy', 'mujoco', 'gymnasium'}\n"
    assert python(code + "print(others & sys.modules.keys())").strip() == "set()"


def test_a_program_without_sources_has_the_same_names(tmp_path: Path) -> None:
    folder = Path(importlib.import_module("canopen_device").__file__ or "").parent
    shutil.copytree(folder, tmp_path / "canopen_device", ignore=shutil.ignore_patterns("__pycache__"))
    assert compileall.compile_dir(tmp_path, quiet=1, legacy=True)
    for source in tmp_path.rglob("*.py"):
        source.unlink()
    names = "import canopen_device as c; print(*c.__all__, c.Device.__name__, c.__file__)"
    shown = subprocess.run([sys.executable, "-c", names], capture_output=True, text=True, check=True, cwd=tmp_path)
    front_door = importlib.import_module("canopen_device").__all__
    assert shown.stdout.split() == [*front_door, "Device", str(tmp_path / "canopen_device/__init__.pyc")]


def test_a_checker_sees_the_type_of_every_name(tmp_path: Path) -> None:
    lines = [f"import {package}" for package in PACKAGES]
    for package in PACKAGES:
        lines += [f"reveal_type({package}.{name})" for name in importlib.import_module(package).__all__]
    (tmp_path / "main.py").write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", str(tmp_path / "main.py")],
        capture_output=True, text=True, check=False, timeout=800, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("Revealed type is") == len(lines) - len(PACKAGES)
    assert not re.findall(r'Revealed type is "Any"', done.stdout)


def imports(tree: ast.AST) -> set[str]:
    """What a program imports of the project's packages, as ``module.name`` or ``module``."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith(OWN)}
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith(OWN):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def is_public(name: str) -> bool:
    package, _, last = name.rpartition(".")
    return name in PACKAGES or (package in [*PACKAGES, *TOOLS] and last in importlib.import_module(package).__all__)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_documents_import_public_names_only(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    example = r"^\s*(?:>>> |\.\.\. )?((?:from|import) (?:tipforce|canopen_device)\S*.*)$"
    lines = [text] if path.suffix == ".py" else re.findall(example, text, re.M)
    private = {name for line in lines for name in imports(ast.parse(line)) if not is_public(name)}
    assert not private


NAMES = {"thumb": 1, "index": 2, "middle": 3}
LOG = """\
(1700000000.000000) can0 080#
(1700000000.000120) can0 285#2E1129239A110303
(1700000000.000240) can0 286#D0072823E8030303
(1700000000.001000) can0 080#
(1700000000.001120) can0 285#3011282394110305
rubbish
(1700000000.001240) can0 286#0500008000801204
"""


def test_rows_by_the_name_of_a_finger() -> None:
    with tipforce.simulated_hand(3, {1: (2.0, 90.0, 45.0)}) as bus, tipforce.Hand.open(NAMES, bus=bus) as hand:
        rows = list(itertools.islice(hand.rows(timeout_s=5.0), 5))
        # On a loaded machine a finger may have no new sample for a SYNC, and says so in that row.
        later = itertools.chain(rows, hand.rows(timeout_s=5.0))
        row = next(row for row in later if all(row[name].reason != "no new sample" for name in NAMES))
        assert list(row) == list(NAMES)
        assert row["thumb"] is row[1]
        assert abs(row["thumb"].P_newtons - 2.0) < 5.0 * row["thumb"].u_P_newtons
        assert row["index"].reason == "no contact"
        assert [b.number - a.number for a, b in itertools.pairwise(rows)] == [1] * 4
        with pytest.raises(KeyError, match="the hand has thumb"):
            _ = row["ring"]
        bus.inject_fault(2, "open", gauge=2)
        assert any("front-end fault" in row["index"].reason for row in itertools.islice(hand.rows(5.0), 200))
    with pytest.raises(tipforce.EnvironmentLackError):
        bus.sync()


def test_a_hand_with_a_finger_that_is_not_there() -> None:
    with tipforce.simulated_hand(2) as bus:
        with pytest.raises(tipforce.RefusedError, match=r"middle \(3\): failed at find"):
            tipforce.Hand.open(NAMES, bus=bus)
        with tipforce.Hand.open(NAMES, bus=bus, need_all=False) as hand:
            row = next(iter(hand.rows(5.0)))
    assert row["middle"].reason == "no response"
    assert math.isnan(row["middle"].P_newtons)


def test_a_log_as_arrays(tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    path.write_text(LOG)
    log = tipforce.read_log(path)
    assert list(log) == [5, 6]
    five = log[5]
    assert five.P_newtons.tolist() == [4.398, 4.4]
    assert five.theta_deg[0] == 45.06
    assert five.counter.tolist() == [3, 5]
    assert np.allclose(five.t_s - 1.7e9, [0.00012, 0.00112], atol=1e-6)
    assert log.lost == {5: 1, 6: 0}
    assert log.bad_lines == 1
    assert log[6].P_newtons.tolist() == [2.0, 0.005]
    assert np.isnan(log[6].theta_deg[1])
    assert np.isnan(five.u_P_newtons).all()
    with pytest.raises(KeyError, match="the log has 5, 6"):
        _ = log[7]
    assert np.isfinite(tipforce.read_log(path, calibration=beam_calibration())[5].u_P_newtons).all()
    with pytest.raises(tipforce.InputError, match="line 6"):
        tipforce.read_log(path, strict=True)


def test_a_log_as_tables_has_what_decode_writes(tmp_path: Path) -> None:
    """Arrow and pandas: the columns of `tipforce decode -o x.parquet`, and the uncertainties and the status beside."""
    scene, log, parquet = (tmp_path / name for name in ("hand.toml", "run.log", "run.parquet"))
    hand = (shipped_folder("scenes") / "hand.toml").read_text().partition("[[expect]]")[0]
    scene.write_text(hand.replace("duration_s = 20.0", "duration_s = 2.2"))
    assert main(["run", str(scene), "-o", str(log), "-q"]) == 0
    assert main(["decode", str(log), "-o", str(parquet), "-q"]) == 0
    found = tipforce.read_log(str(tmp_path / "r*.log"))
    written = pq.read_table(parquet).sort_by([("t_s", "ascending"), ("node", "ascending")])
    table = found.to_arrow()
    assert set(table.column_names) - set(written.column_names) == {"u_phi_deg", "u_theta_deg", "status"}
    for name in written.column_names:
        assert table[name].cast(written[name].type).to_pylist() == written[name].to_pylist(), name
    frame = found[3].to_pandas()
    assert len(frame) == len(found[3])
    assert frame["P_N"].max() == np.nanmax(found[3].P_newtons)
    assert len(repr(found).splitlines()) <= 6
    assert len(repr(found[3]).splitlines()) == 5
    lines = log.read_text().splitlines(keepends=True)
    for number, part in ((2, lines[:900]), (10, lines[900:])):
        (tmp_path / f"part-{number}.log").write_text("".join(part))
    assert tipforce.read_log(tmp_path / "part-*.log").lost == dict.fromkeys(found, 0)
    with pytest.raises(tipforce.InputError, match=r"x\*\.log: no file matches"):
        tipforce.read_log(str(tmp_path / "x*.log"))


def test_a_log_of_gauges_is_estimated_by_the_calibration(tmp_path: Path) -> None:
    C = calibration_matrix(FABRICATED, "I")
    F = force_vector(2.0, math.radians(90.0), math.radians(45.0))
    counts = np.round(10.0 * 1e6 * strain_matrix(FABRICATED, "I") @ F).astype(np.int16)
    path = tmp_path / "gauges.log"
    path.write_text(
        f"(1.000000) can0 185#{counts.tobytes().hex().upper()}0001\n(1.100000) can0 185#0080{'00' * 4}8002\n"
    )
    calibration = tipforce.Calibration.from_microstrain(C * 1e-6, noise=0.5, pull=True)
    found = tipforce.read_log(path, calibration={5: calibration})[5]
    assert abs(found.P_newtons[0] - 2.0) < 0.01
    assert abs(found.theta_deg[0] - 45.0) < 0.5
    assert np.isnan(found.P_newtons[1])
    assert found.microstrain.shape == (2, 3)


def test_one_node_on_two_buses_needs_a_channel(tmp_path: Path) -> None:
    path = tmp_path / "two.log"
    path.write_text("(1.000000) can0 285#2E1129239A110303\n(1.000000) can1 285#3011282394110303\n")
    with pytest.raises(tipforce.InputError, match="node 5 is on several buses; choose a channel: can0, can1"):
        tipforce.read_log(path)
    assert tipforce.read_log(path, channel="can1")[5].P_newtons.tolist() == [4.4]
    with pytest.raises(tipforce.InputError, match="no frame of channel 'can2'"):
        tipforce.read_log(path, channel="can2")


def test_a_calibration_from_a_matrix_goes_through_a_file(tmp_path: Path) -> None:
    C = calibration_matrix(FABRICATED, "I") * 1e-6
    made = tipforce.Calibration.from_microstrain(C, [12.0, -3.0, 5.0], np.eye(3) * 0.25, pull=True, serial=1005)
    made.write(tmp_path / "finger.toml")
    assert tipforce.Calibration.read(tmp_path / "finger.toml").record() == made.record()
    assert np.allclose(made.offset_strain, [12e-6, -3e-6, 5e-6])
    assert made.pull
    found = tipforce.estimate(made, [112.0, 97.0, 105.0])
    F = (C @ [100.0, 100.0, 100.0])[:3]
    assert math.isclose(found.P_newtons[0], math.hypot(F[0], F[2]), rel_tol=1e-9)
    assert found.u_P_newtons[0] > 0.0


def test_a_fit_keeps_its_uncertainty_through_a_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    theta = np.radians(np.tile(np.arange(10.0, 175.0, 11.0), 2))
    phi = np.radians(np.repeat([0.0, 90.0], len(theta) // 2))
    P = np.where(np.arange(len(theta)) % 5 == 0, 0.0, 3.0)
    strain = force_vector(P, phi, theta) @ strain_matrix(FABRICATED, "I").T + rng.normal(0, 5e-7, (len(theta), 3))
    fit = tipforce.fit_calibration(tipforce.Readings(strain, P, phi, theta))
    calibration = tipforce.Calibration.from_fit(fit, pull=True, serial=7)
    calibration.write(tmp_path / "fit.toml")
    with_fit = tipforce.estimate(tipforce.Calibration.read(tmp_path / "fit.toml"), strain[:1] * 1e6)
    write_calibration(tmp_path / "bare.toml", calibration)
    bare = tipforce.estimate(tipforce.Calibration.read(tmp_path / "bare.toml"), strain[:1] * 1e6)
    assert with_fit.u_P_newtons[0] > 1.05 * bare.u_P_newtons[0]
    assert with_fit.P_newtons[0] == bare.P_newtons[0]
