"""`tipforce calibrate fit|apply|verify|guide`: from readings to a calibration file, and from the file to a node."""

from __future__ import annotations

import argparse
import importlib

from tipforce_tools import common

# name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)
ACTIONS = {
    "fit": ("tipforce_tools.calibrate.fit", "fit a calibration to readings under known loads"),
    "apply": ("tipforce_tools.calibrate.transfer", "write a calibration file to a node, verify and store it"),
    "guide": ("tipforce_tools.calibrate.guide", "weight by weight at a node, to a stored calibration; resumable"),
    "verify": ("tipforce_tools.calibrate.transfer", "compare a calibration file with what a node holds"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The action; its own flags are for its own parser: the bus flags alone cost a fifth of a second."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    actions = "\n".join(f"  {name:7} {summary}" for name, (_, summary) in ACTIONS.items())
    parser.epilog = f"actions:\n{actions}\n\n`tipforce calibrate ACTION --help` tells each one's options."
    parser.add_argument("action", choices=ACTIONS, metavar="ACTION", help=", ".join(ACTIONS))
    parser.add_argument("words", nargs=argparse.REMAINDER, metavar="...", help="options of the action")


def run(args: argparse.Namespace) -> int:
    """Run the action; its exit code."""
    module_name, summary = ACTIONS[args.action]
    module = importlib.import_module(module_name)
    description = summary[0].upper() + summary[1:] + "."
    parser = argparse.ArgumentParser(prog=f"tipforce calibrate {args.action}", description=description)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    module.add_arguments(parser)
    parsed = parser.parse_intermixed_args(args.words, argparse.Namespace(action=args.action))
    common.set_up_logging(parsed)
    code: int = module.run(parsed)
    return code
