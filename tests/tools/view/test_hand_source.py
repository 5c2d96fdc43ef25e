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
from websockets.sync.client import connect

from tipforce_tools.demo.hand import PULLS, load_at, simulated_hand
from tipforce_tools.view import serving

WAIT_S = 60.0


def test_the_simulated_hand_is_shown_as_it_is_loaded() -> None:
    with simulated_hand(moving=False) as (hand, sources):
        for k, gauges in enumerate(sources):
            gauges.load = load_at(k, 3.0)
        source = serving.hand_source(argparse.Namespace(quiet=True), hand, "simulated hand")
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
        assert source.model.counters.load[0] is not None


def test_the_loads_lie_where_a_contact_can_be() -> None:
    """A push goes inwards, a pull outwards."""
    for k in range(5):
        for t_s in np.linspace(0, 60, 200):
            P, phi, theta = load_at(k, float(t_s))
            assert P >= 0
            assert 40 <= theta <= 140
            assert (np.cos(np.radians(phi - theta)) > 0.9) == PULLS[k]


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
