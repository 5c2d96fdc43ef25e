"""Scene files that cannot be used, each complaint with place, value and what is allowed; and loads over time."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipforce.errors import InputError
from tipforce.scene import Scene, read_scene, schema
from tipforce.scene.results import applied_at
from tipforce.scene.schema import LoadHistory
from tipforce.sensor.calibration.simulation import paper_grooves

GOOD = """
duration_s = 1.0
sync_hz = 100

[[nodes]]
ids = [1, 2]
pdos = ["contact"]

[[loads]]
kind = "static"
P_N = 1.0
phi_deg = -90
theta_deg = 80
"""
NUMBERS = st.floats(-1e3, 1e3, allow_subnormal=False)


def read(tmp_path: Path, text: str) -> Scene:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return read_scene(path)


WRONG = [  # a part of the good scene, what stands there instead, and what is said
    ("duration_s = 1.0", "", "duration_s is missing"),
    ("duration_s = 1.0", "duration_s = 0.0", "duration_s is 0.0: expected float > 0.0"),
    ("duration_s = 1.0", 'duration_s = "1"', "duration_s is '1': expected float, got str"),
    ("duration_s = 1.0", "duration_s = nan", "duration_s is nan: allowed are finite numbers"),
    ("duration_s = 1.0", "duration_s = inf", "duration_s is inf: allowed are finite numbers"),
    ("duration_s", "duration", "duration: no such key; did you mean duration_s?"),
    ("sync_hz = 100", "sync_hz = 100\nstart = 9999-01-01T00:00:00Z", "allowed are the years 1970 to 2261"),
    ("sync_hz = 100", "sync_hz = 100\nstart = 1970-01-01T00:00:00+14:00", "allowed are the years 1970 to 2261"),
    ("sync_hz = 100", "", "nodes[1].pdos: contact is sent on SYNC: set sync_hz"),
    ("ids = [1, 2]", "ids = [1, 1]", "node-id 1 is given more than once"),
    ("ids = [1, 2]", "ids = []", "0 node-ids: allowed are 1 to 32"),
    ("ids = [1, 2]", "ids = [0]", "nodes[1].ids is [0]: expected int >= 1 at [0]"),
    ("ids = [1, 2]", "ids = 1", "nodes[1].ids is 1: expected array, got int"),
    ("ids = [1, 2]", 'ids = [1, 2]\nlayout = "IV"', "nodes[1].layout is 'IV'"),
    ("ids = [1, 2]", 'ids = [1, 2]\nlayout = ["L", "R"]', "a layout of 2 gauge points: allowed are 3 to 8"),
    ("ids = [1, 2]", 'ids = [1]\nfilter = "moving_average"\nfilter_constant = 257', "of 257: allowed are 1 to 256"),
    ("ids = [1, 2]", "ids = [1, 2]\noffset_microstrain = [1.0]", "offset_microstrain has 1 values: allowed is 3"),
    ('["contact"]', '["contract"]', "nodes[1].pdos is ['contract']: invalid enum value 'contract' at [0]; allowed"),
    ('kind = "static"', "", "loads[1].kind is missing; allowed: static, history, grooves, ramp, tap, grasp"),
    ('kind = "static"', "kind = {}", "loads[1].kind is {}"),
    ('kind = "static"', 'kind = "statik"', "loads[1].kind is 'statik'; did you mean static?"),
    ("P_N = 1.0", "P_N = -1.0", "loads[1].P_N is -1.0: expected float >= 0.0"),
    ("P_N = 1.0", "P_N = 1e300", "loads[1].P_N is 1e+300: expected float <= 1000000000.0"),
    ("P_N = 1.0", "P_n = 1.0", "loads[1].P_n: no such key; did you mean P_N?"),
    ("P_N = 1.0", "P_N = 1.0\nnodes = [7]", "loads[1].nodes: node 7 is not in [[nodes]]; allowed: 1, 2"),
    ("[[loads]]", "[loads]", "loads is {"),
    ("[[nodes]]", "[[node]]", "node: no such key; did you mean nodes?"),
    ("[[nodes]]", "[[nodes", "line 5"),
]
ADDED = [  # below the good scene
    ('[[loads]]\nkind = "grooves"', "loads[2]: node 1 already has a load, loads[1]"),
    ("[noise]\ngauge_microstrain = 0", "noise.gauge_microstrain is 0: expected float > 0.0"),
    ("[front_end]\napparent_microstrain_per_degC = [1]", "has 1 values: allowed is one number, or 3, the gauges of no"),
    ("[dynamics]\nstep_us = 300", "sample_period_us is 500: allowed are multiples of the step of [dynamics], 300"),
    ('[[faults]]\nkind = "stuck"\nnodes = [1]\nat_s = 0.5\ngauge = 4', "gauge is 4: node 1 has the gauges 1 to 3"),
    ('[[faults]]\nkind = "stuck"\nnodes = [3]\nat_s = 0.5', "faults[1].nodes: node 3 is not in [[nodes]]"),
    ('[[faults]]\nkind = "stuck"\nnodes = [1]\nat_s = 0.5\nuntil_s = 0.4', "allowed is a time after at_s, 0.5"),
    ('[[faults]]\nkind = "stuck"\nnodes = []\nat_s = 0.5', "faults[1].nodes is []: allowed are one"),
    (
        '[[faults]]\nkind = "open"\nnodes = [1]\nat_s = 0.1\n[[faults]]\nkind = "open"\nnodes = [1]\nat_s = 0.2',
        "faults[2]: node 1 has another fault at that time",
    ),
    ('[[faults]]\nkind = "open"\nnodes = [1]\nat_s = 0.1\nmicrostrain_per_s = 1', "allowed only for a drift"),
    ('[[expect]]\nstatus_seen = ["satured"]', "'satured' is not a bit of the status byte; allowed: contact"),
    ('[[expect]]\nemcy_seen = ["0x5010"]', "allowed are four hexadecimal digits"),
    ("[[expect]]\nfrom_s = 0.5\nto_s = 2.0", "allowed are times within duration_s"),
    ("[[expect]]\nslit_closes = true", "needs a table [slit]"),
    ("[outputs]\nlogg = 1", "outputs.logg: no such key; did you mean log?"),
]
LOADS = [  # in place of its load
    ('kind = "history"\nt_s = [0, 1]\nP_N = [1]\nphi_deg = 0\ntheta_deg = 0', "P_N has 1 values"),
    ('kind = "history"\nt_s = [1, 0]\nP_N = 1\nphi_deg = 0\ntheta_deg = 0', "allowed are non-decreasing times"),
    ('kind = "history"\nt_s = []\nP_N = 1\nphi_deg = 0\ntheta_deg = 0', "allowed are 0 (as t_s)"),
    ('kind = "ramp"\nto_N = 1\nend_s = 1\nstart_s = 1\nphi_deg = 0\ntheta_deg = 0', "a time after start_s"),
    ('kind = "tap"\nP_N = 1\nat_s = [0.1, 0.101]\nphi_deg = 0\ntheta_deg = 0', "at least 0.002 s apart"),
    ('kind = "grasp"\nfingers = [{node = 3, P_N = 1, phi_deg = 0, theta_deg = 0}]', "fingers: node 3 is not in"),
    ('kind = "grasp"\nfingers = [{node = 1, phi_deg = 0, theta_deg = 0}]', "loads[1].fingers[1].P_N is missing"),
]
LOAD = GOOD.partition("[[loads]]\n")[2]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        *WRONG,
        *(("", f"{GOOD}\n{more}\n", message) for more, message in ADDED),
        *((LOAD, f"{load}\n", m) for load, m in LOADS),
    ],
)
def test_a_bad_scene(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path, GOOD.replace(old, new, 1) if old else new)
    assert message in str(caught.value)
    assert "scene.toml: " in str(caught.value)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "No such file"),
        (b"a = " + b"[" * 50_000, "brackets are nested too deeply"),
        (b"a = " + b"1" * 5_000, "4300 digits"),
        (b"a = [", "scene.toml: "),
        (b"\xff\xfe", "not UTF-8"),
        (b"\xef\xbb\xbfduration_s = -1\n", "duration_s"),  # a byte order mark is allowed
    ],
)
def test_a_file_that_is_no_toml(tmp_path: Path, content: bytes | None, told: str) -> None:
    if content is not None:
        (tmp_path / "scene.toml").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_scene(tmp_path / "scene.toml")
    assert told in str(caught.value)


def test_lines_between_knots_and_steps_at_them() -> None:
    load = LoadHistory([(1.0, 0.0, 0.0, 0.0), (2.0, 4.0, 10.0, 20.0), (2.0, 1.0, 0.0, 0.0), (3.0, 1.0, 0.0, 0.0)])
    assert load.at(0.0) == (0.0, 0.0, 0.0)
    assert load.at(1.25) == (1.0, 2.5, 5.0)
    assert load.at(2.0) == (1.0, 0.0, 0.0)
    assert load.at(9.0) == (1.0, 0.0, 0.0)
    assert not load.constant


@given(st.lists(st.tuples(st.integers(0, 20), NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=8), st.data())
def test_the_vectorised_form_is_the_same(knots: list[tuple[int, float, float, float]], data: st.DataObject) -> None:
    load = LoadHistory(sorted(((0.25 * t, P, phi, theta) for t, P, phi, theta in knots), key=lambda knot: knot[0]))
    times = data.draw(st.lists(st.floats(-1.0, 7.0), min_size=1, max_size=20)) + [knot[0] for knot in load.knots]
    expected = np.array([load.at(t) for t in times])
    np.testing.assert_allclose(applied_at(load, np.array(times)), expected, rtol=1e-12, atol=1e-9)


def test_the_grooves_are_the_papers() -> None:
    load = schema.Grooves(P_N=4.4, dwell_s=0.1, change_s=0.03).history(1)
    assert load is not None
    grooves = paper_grooves()
    found = [load.at(0.01 + 0.13 * k + 0.05) for k in range(19)]
    expected = [
        (4.4, float(phi), float(theta))
        for phi, theta in zip(np.degrees(grooves.phi_rad), np.degrees(grooves.theta_rad), strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert [load.at(0.13 * k + 0.125)[0] for k in range(19)] == [0.0] * 19


def test_a_grasp_gives_each_finger_its_own() -> None:
    fingers = (
        schema.Finger(node=1, P_N=2.0, phi_deg=-90, theta_deg=80),
        schema.Finger(node=2, P_N=1.0, phi_deg=-80, theta_deg=90, delay_s=0.1),
    )
    grasp = schema.Grasp(fingers=fingers, start_s=0.5, close_s=0.2, hold_s=1.0, open_s=0.4)
    one, two = (grasp.history(node_id) for node_id in (1, 2))
    assert one is not None
    assert two is not None
    assert grasp.history(3) is None
    assert [one.at(t)[0] for t in (0.5, 0.7, 1.7, 2.1)] == pytest.approx([0.0, 2.0, 2.0, 0.0])
    assert one.at(0.6) == pytest.approx((1.0, -90.0, 80.0))
    assert two.at(0.7) == pytest.approx((0.5, -80.0, 90.0))


def test_taps_rise_and_fall() -> None:
    load = schema.Tap(P_N=5.0, at_s=(0.2, 0.1), phi_deg=0, theta_deg=0, rise_ms=1, fall_ms=3).history(1)
    assert load is not None
    assert [load.at(t)[0] for t in (0.05, 0.1, 0.1005, 0.101, 0.1025, 0.104, 0.15, 0.201, 0.3)] == pytest.approx(
        [0.0, 0.0, 2.5, 5.0, 2.5, 0.0, 0.0, 5.0, 0.0]
    )
