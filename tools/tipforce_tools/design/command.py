"""`tipforce design table|sweep|optimise`: the structure of the sensor. Loads only the action that runs."""

from __future__ import annotations

import argparse
import importlib

# name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)
ACTIONS = {
    "table": ("tipforce_tools.design.table", "the paper's tables and figures recomputed, beside what it prints"),
    "sweep": ("tipforce_tools.design.sweep", "condition number and noise against a dimension or a gauge shift"),
    "optimise": ("tipforce_tools.design.optimise", "look for better dimensions and gauge positions"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The action; its own flags are for its own parser."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    actions = "\n".join(f"  {name:9} {summary}" for name, (_, summary) in ACTIONS.items())
    parser.epilog = f"actions:\n{actions}\n\n`tipforce design ACTION --help` tells each one's options."
    parser.add_argument("action", choices=ACTIONS, metavar="ACTION", help=", ".join(ACTIONS))
    parser.add_argument("words", nargs=argparse.REMAINDER, metavar="...", help="options of the action")


def run(args: argparse.Namespace) -> int:
    """Run the action; its exit code."""
    module_name, summary = ACTIONS[args.action]
    module = importlib.import_module(module_name)
    description = summary[0].upper() + summary[1:] + "."
    parser = argparse.ArgumentParser(prog=f"tipforce design {args.action}", description=description)
    module.add_arguments(parser)
    code: int = module.run(parser.parse_intermixed_args(args.words))
    return code
