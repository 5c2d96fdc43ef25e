"""`tipforce calibrate fit|apply|verify|guide`: from readings to a calibration file, and from the file to a node."""

from __future__ import annotations

import argparse

from tipforce_tools.cli.actions import add_action, run_action

ACTIONS = {
    "fit": ("tipforce_tools.calibrate.fit", "fit a calibration to readings under known loads"),
    "apply": ("tipforce_tools.calibrate.transfer", "write a calibration file to a node, verify and store it"),
    "guide": ("tipforce_tools.calibrate.guide", "calibrate a node weight by weight and store the result; resumable"),
    "verify": ("tipforce_tools.calibrate.transfer", "compare a calibration file with that of a node"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the action; its own parser has its flags."""
    add_action(parser, "calibrate", ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Run the action and return its exit code."""
    return run_action(args, "calibrate", ACTIONS)
