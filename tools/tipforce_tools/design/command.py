"""`tipforce design table|sweep|optimise`: the structure of the sensor. Imports only the chosen action."""

from __future__ import annotations

import argparse

from tipforce_tools.cli.actions import add_action, run_action

ACTIONS = {
    "table": ("tipforce_tools.design.table", "recompute the paper's tables and figures, beside the printed values"),
    "sweep": ("tipforce_tools.design.sweep", "compute condition number and noise over a dimension or a gauge shift"),
    "optimise": ("tipforce_tools.design.optimise", "search better dimensions and gauge positions"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the action; its own parser has its flags."""
    add_action(parser, "design", ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Run the action and return its exit code."""
    return run_action(args, "design", ACTIONS)
