"""The simulated hand of `demo --view`, and the command that shows it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from websockets.sync.client import connect

from tipforce.errors import InputError
from tipforce_tools.cli.main import main
from tipforce_tools.view import command
from tipforce_tools.view.demo import PULLS, load_at, simulated_hand

WAIT_S = 60.0


def test_the_simulated_hand_is_shown_as_it_is_loaded() -> None:
    with simulated_hand(moving=False) as (hand, nodes):
        for k, gauges in enumerate(nodes.sources):
            gauges.load = load_at(k, 3.0)
        source = command.hand_source(argparse.Namespace(quiet=True), hand, "simulated hand")
        deadline_s = time.monotonic() + WAIT_S
        while True:
            source.pump()
            states = source.model.picture().states
            if all(state.word == "live" for state in states) and source.model.counters.rows > 5:
                break
            assert time.monotonic() < deadline_s
            time.sleep(0.02)
        for k, state in enumerate(states):
            P, phi, theta = load_at(k, 3.0)
            u = np.array(state.u)
            error = np.abs(np.array(state.contact) - (P, phi, theta))
            assert (error < 6 * u + (0.002, 0.2, 0.2)).all()
            assert np.isfinite(state.gauges).all()
        assert source.model.nmt == ["operational"] * 5
        assert source.tare(1).startswith("tare: F1 ")
        assert source.model.counters.load_low is not None


def test_the_loads_lie_where_a_contact_can_be() -> None:
    """A push goes inwards, a pull outwards."""
    for k in range(5):
        for t_s in np.linspace(0, 60, 200):
            P, phi, theta = load_at(k, float(t_s))
            assert P >= 0
            assert 40 <= theta <= 140
            assert (np.cos(np.radians(phi - theta)) > 0.9) == PULLS[k]


@pytest.mark.parametrize(
    "words",
    [["--host", "192.0.2.1"], ["--host", "0.0.0.0", "--token", "auto"], ["--port", "70000"], ["--token", "short"]],
)
def test_a_wrong_server_is_refused_before_anything_opens(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--view", *words]) == 2
    assert main(["view", "no.log", *words]) == 2
    assert words[0] in capsys.readouterr().err


def test_wrong_sources_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["no.log"], ["no.toml"], ["-"], ["run.log", "--no-bring-up"]):
        assert main(["view", *words, "-i", "virtual", "--port", "0"]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_the_command_serves_and_ends_quietly() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tipforce_tools.cli.main", "view", "-i", "virtual", "--port", "0", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    assert process.stdout is not None
    url = json.loads(process.stdout.readline())["url"]
    with connect(url.replace("http", "ws") + "live") as page:
        page.send('{"do": "setup"}')
        setup = json.loads(page.recv(WAIT_S))["answer"]
    assert setup["fingers"] == []
    assert setup["no_tare"] == "this page only listens to the bus"
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, out) == (0, "")
    assert "Traceback" not in err


def test_input_error_is_the_only_error() -> None:
    with pytest.raises(InputError):
        command.check_server_arguments(argparse.Namespace(host="hand.local", token=None, port=0))
