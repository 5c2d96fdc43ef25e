"""The command `tipforce`: finds the subcommand, loads only that one, and turns errors into messages and exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tipforce.errors import (
    EnvironmentLackError,
    InputError,
    NoResponseError,
    RefusedError,
    SdoAbortError,
    TipforceError,
)

if TYPE_CHECKING:
    from tipforce_tools.cli.actions import CommandParser

# name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)
COMMANDS = {
    "demo": ("tipforce_tools.demo.command", "the main job with no hardware: calibrate, store, load, decode, compare"),
    "node": ("tipforce_tools.node.command", "run one fingertip node on a bus"),
    "run": ("tipforce_tools.scene.run", "run a scene: a hand of nodes, loads, faults, recording"),
    "scene": ("tipforce_tools.scene.command", "explain what a scene builds, and what it leaves out and why"),
    "scan": ("tipforce_tools.network.scan", "list the nodes on the bus"),
    "read": ("tipforce_tools.network.read", "read the contact of fingers, with its uncertainty"),
    "sdo": ("tipforce_tools.sdo.command", "read or write an object of a node, or read them all"),
    "hand": ("tipforce_tools.hand.command", "bring a hand of many fingers up from its file, and run it"),
    "nmt": ("tipforce_tools.network.nmt", "start, stop or reset nodes, and wait for their heartbeats"),
    "lss": ("tipforce_tools.network.lss", "find nodes without a node-id, and give node-ids"),
    "config": ("tipforce_tools.network.config", "show, apply, compare or save a node's settings (TOML or DCF)"),
    "calibrate": ("tipforce_tools.calibrate.command", "fit a calibration, apply it to a node, verify it"),
    "tare": ("tipforce_tools.network.tare", "take the present force as zero, show what is taken off, or end it"),
    "estimate": ("tipforce_tools.estimate.command", "gauge readings to contact, with standard uncertainties"),
    "budget": ("tipforce_tools.budget.command", "the error budget of P, phi and theta, by cause"),
    "dump": ("tipforce_tools.dump.command", "show frames as candump does, with --decode also their contact values"),
    "decode": ("tipforce_tools.decode.command", "logs to contact: text, CSV, JSON lines, Parquet, MCAP"),
    "log": ("tipforce_tools.log.command", "record frames to a file that canplayer and Wireshark open"),
    "replay": ("tipforce_tools.replay.command", "send the frames of a log again, in their own time"),
    "plot": ("tipforce_tools.plot.command", "draw the contact, gauges and faults of a log"),
    "monitor": ("tipforce_tools.monitor.command", "a live table of the nodes on a bus or in a log"),
    "view": ("tipforce_tools.view.command", "a web page: the force on each fingertip, live and from a log"),
    "load": ("tipforce_tools.network.load", "how full a bus is, and whether a hand on paper fits"),
    "design": ("tipforce_tools.design.command", "the structure: the paper's tables, sweeps, better structures"),
    "report": ("tipforce_tools.report.command", "error against run time, and what happens in extreme cases"),
    "conformance": ("tipforce_tools.conformance.command", "check a CANopen device by the clauses of the standard"),
    "export": ("tipforce_tools.export", "write EDS, DBC, DCF, or C for firmware, from the object dictionary"),
    "completion": ("tipforce_tools.completion.command", "the shell's TAB completion of all commands"),
    "doctor": ("tipforce_tools.doctor.command", "what stands between this machine and a working bus, with next steps"),
    "vcan": ("tipforce_tools.vcan.command", "run a command on a kernel that has vcan"),
}

EXIT_CODES: dict[type[TipforceError], int] = {
    InputError: 2,
    NoResponseError: 5,
    EnvironmentLackError: 2,
    SdoAbortError: 11,
    RefusedError: 12,
}
PERMISSION, INTERRUPTED = 9, 130

USAGE = """usage: tipforce COMMAND [options]

The CANopen stack for fingertip force sensors.

commands:
{commands}

`tipforce COMMAND --help` tells each command's options. Data goes to stdout, everything else to stderr.
exit codes: 0 ok, 1 the check that was asked for failed, 2 usage, 5 no response, 9 permission, 11 SDO abort,
12 the device refused, 130 interrupted
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; returns the exit code. No traceback for anything that a user can cause."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _answer(words)
        sys.stdout.flush()
        return code
    except TipforceError as error:
        return _failed(str(error), _exit_code(error))
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader (head, less) has seen enough. Python would complain again when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a full disk behind stdout, a file that vanished
        return _failed(str(error), PERMISSION if isinstance(error, PermissionError) else 1)


def _answer(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        width = max(map(len, COMMANDS))
        lines = (f"  {name:{width}}  {summary}" for name, (_, summary) in COMMANDS.items())
        print(USAGE.format(commands="\n".join(lines)), end="")
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        from tipforce.dictionary.table import SOFTWARE_VERSION

        print(f"tipforce {SOFTWARE_VERSION}")
        return 0
    try:
        return _run(words[0], words[1:])
    except SystemExit:
        sys.stdout.flush()  # of argparse's help: a reader that left is noticed here, not when Python ends
        raise


def _run(name: str, words: list[str]) -> int:
    if name not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(name, COMMANDS, 3)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(COMMANDS)}"
        return _failed(f"{name!r} is not a command; {hint}", 2)
    import importlib

    parser = command_parser(name)
    # Flags may stand between the positional words, but not inside another program's command line.
    passes_on = any(action.nargs == "..." for action in parser._actions)  # argparse.REMAINDER
    args = parser.parse_args(words) if passes_on else parser.parse_intermixed_args(words)
    return int(importlib.import_module(COMMANDS[name][0]).run(args))


def command_parser(name: str) -> CommandParser:
    """The parser of the command line of COMMANDS' ``name``."""
    import importlib
    import re

    from tipforce_tools.cli.actions import CommandParser

    module_name, summary = COMMANDS[name]
    parser = CommandParser(prog=f"tipforce {name}", description=summary[0].upper() + summary[1:] + ".")
    # argparse itself takes -1.5e-3 and -1,0,0 for flags that it does not know.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    importlib.import_module(module_name).add_arguments(parser)
    return parser


def _exit_code(error: TipforceError) -> int:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, PermissionError):
            return PERMISSION
        cause = cause.__cause__ or cause.__context__  # "from None" hides the context from print, not from here
    return next((code for kind, code in EXIT_CODES.items() if isinstance(error, kind)), 1)


def _failed(message: str, code: int) -> int:
    print(f"tipforce: {message}", file=sys.stderr)
    return code


def terminate_as_interrupt() -> None:
    """Let SIGTERM end a long-running command as Ctrl-C does, so that it closes what it opened."""

    import signal

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)


if __name__ == "__main__":
    sys.exit(main())
