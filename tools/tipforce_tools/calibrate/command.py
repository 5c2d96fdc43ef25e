"""`tipforce calibrate fit|apply|verify|guide`: from readings to a calibration file, and from the file to a node."""

from __future__ import annotations

import argparse

from tipforce_tools.cli.actions import add_action, run_action

ACTIONS = {
    "fit": ("tipforce_tools.calibrate.fit", "fit a calibration to readings under known loads"),
    "apply": ("tipforce_tools.calibrate.transfer", "write a calibration file to a node, verify and store it"),
    "guide": ("tipforce_tools.calibrate.guide", "weight by weight at a node, to a stored calibration; resumable"),
    "verify": ("tipforce_tools.calibrate.transfer", "compare a calibration file with what a node holds"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The action; its flags come when it is chosen."""
    add_action(parser, "calibrate", ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Run the action; its exit code."""
    return run_action(args, "calibrate", ACTIONS)
