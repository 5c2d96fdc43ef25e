"""`tipforce scene ACTION`."""

from __future__ import annotations

import argparse

from tipforce_tools.cli import actions

ACTIONS = {
    "explain": ("tipforce_tools.scene.explain", "list what a scene builds, what it leaves out, and why"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the action."""
    actions.add_action(parser, "scene", ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Run the action and return its exit code."""
    return actions.run_action(args, "scene", ACTIONS)
