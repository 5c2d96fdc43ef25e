"""`tipforce design table|sweep|optimise`: the structure of the sensor. Loads only the action that runs."""

from __future__ import annotations

import argparse

from tipforce_tools.cli.actions import add_action, run_action

ACTIONS = {
    "table": ("tipforce_tools.design.table", "the paper's tables and figures recomputed, beside what it prints"),
    "sweep": ("tipforce_tools.design.sweep", "condition number and noise against a dimension or a gauge shift"),
    "optimise": ("tipforce_tools.design.optimise", "look for better dimensions and gauge positions"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The action; its flags come when it is chosen."""
    add_action(parser, "design", ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Run the action; its exit code."""
    return run_action(args, "design", ACTIONS)
