"""The steps of a guided calibration, from flags and from a plan file; and flags that are refused before any weight."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from host.bus_with_nodes import connected, new_channel
from tipforce.errors import InputError
from tipforce.fingertip.node import fingertip_node
from tipforce.fingertip.source import Reading, Source
from tipforce.host.configuration.guide import file_plan, groove_plan
from tipforce_tools.cli.main import main

RIG = """
tare_every = 2
[[step]]
P_N = 1.5
phi_deg = 10
theta_deg = 40
[[step]]
P_N = 2
phi_deg = -170
theta_deg = 90
mode = "push"
instruction = "press with the stamp"
[[step]]
P_N = 2
phi_deg = 90
theta_deg = 20
[[step]]
P_N = 2
phi_deg = -90
theta_deg = 60
"""


def test_the_papers_grooves() -> None:
    steps = groove_plan("4.4,2.2", "paper")
    loads = [step for step in steps if step.mode != "tare"]
    assert [step.number for step in steps] == list(range(1, len(steps) + 1))
    assert len(loads) == 2 * 19
    assert {step.P_newtons for step in loads} == {4.4, 2.2}
    assert steps[0].mode == steps[-1].mode == "tare"
    assert loads[2].load == (4.4, 0.0, 30.0, "pull")
    assert loads[2].instruction == "hang 4.4 N (448.7 g) in the x-groove at theta = 30 degrees (phi = 0)"
    assert loads[9].load == (4.4, 180.0, 175.0, "pull")
    assert loads[10].load == (4.4, 90.0, 30.0, "pull")
    assert all(b - a <= 5 for a, b in pairwise([k for k, step in enumerate(steps) if step.mode == "tare"]))


@pytest.fixture
def plan(tmp_path: Path) -> Callable[[str], Path]:
    def write(text: str) -> Path:
        path = tmp_path / "plan.toml"
        path.write_text(text)
        return path

    return write


def test_a_plan_file(plan: Callable[[str], Path]) -> None:
    steps = file_plan(plan(RIG))
    assert [step.mode for step in steps] == ["tare", "pull", "push", "tare", "pull", "pull", "tare"]
    assert steps[1].instruction == "pull with 1.5 N at theta = 40 degrees (phi = 10)"
    assert steps[2].instruction == "press with the stamp"
    own = file_plan(plan(RIG + '[[step]]\nmode = "tare"\ninstruction = "lift the stamp"\n'))
    assert [step.mode for step in own] == ["pull", "push", "pull", "pull", "tare"]
    assert own[-1].instruction == "lift the stamp"


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("P_N = 1.5", "P_N = 0", "step 1: P_N = 0: allowed is above 0"),
        ("P_N = 1.5", "P_N = nan", "step[1].P_N is nan: allowed are finite numbers"),
        ("phi_deg = 10", "phi_deg = 1000", "step 1: phi_deg = 1000.0: allowed is -720 to 720"),
        ("theta_deg = 90", "", "step 2: theta_deg = None"),
        ('"push"', '"twist"', "step[2].mode is 'twist': invalid enum value 'twist'; allowed: pull, push, tare"),
        ('"push"', '"tare"', "step 2 is a tare, an unloaded reading"),
        ("tare_every = 2", "tare_every = 0", "tare_every = 0: allowed is 1 or more"),
        (
            "tare_every = 2",
            "tare_evry = 2",
            "plan.toml: tare_evry: no such key; did you mean tare_every? allowed: step, tare_every",
        ),
        ("theta_deg = 40", "theta = 40", "step[1].theta: no such key; did you mean theta_deg?"),
        ("phi_deg = 10", 'phi_deg = "10"', "step[1].phi_deg is '10': expected float, got str"),
        ("phi_deg = 10", "phi_deg =", "plan "),
    ],
)
def test_a_plan_file_that_is_wrong(plan: Callable[[str], Path], old: str, new: str, reason: str) -> None:
    with pytest.raises(InputError, match=r"plan .*plan.toml: ") as caught:
        file_plan(plan(RIG.replace(old, new, 1)))
    assert reason in str(caught.value)


def test_no_plan_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        file_plan(tmp_path / "plan.toml")
    (tmp_path / "plan.toml").write_text('[[step]]\nmode = "tare"\n')
    with pytest.raises(InputError, match="no step has a load"):
        file_plan(tmp_path / "plan.toml")


@pytest.mark.parametrize(
    ("weights", "grooves", "reason"),
    [
        ("heavy", "paper", "--weights 'heavy': allowed are newtons above 0"),
        ("4.4,-1", "paper", "--weights"),
        ("4.4", "x30,z20", "'z20': allowed are paper, or grooves: x30,y60"),
        ("4.4", "y190", "theta 0 to 180"),
        ("4.4", "x30,x45", "cannot show"),
    ],
)
def test_weights_and_grooves_that_do_not_do(weights: str, grooves: str, reason: str) -> None:
    with pytest.raises(InputError) as caught:
        groove_plan(weights, grooves)
    assert reason in str(caught.value)


class RealGauges(Source):
    """A converter that is no simulation."""

    def read(self, now_us: int) -> Reading:
        return Reading((1, 2, now_us % 7), 0, 2300)


def test_no_auto_with_real_gauges(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    channel = new_channel()
    with connected(fingertip_node(5, RealGauges()), channel=channel):
        words = ["calibrate", "guide", "--node", "5", "--auto", "--session", str(tmp_path / "s.csv")]
        assert main([*words, "-i", "virtual", "-c", channel]) == 2
    assert "node 5 (0x05) has real gauges: --auto needs a simulated node" in capsys.readouterr().err
