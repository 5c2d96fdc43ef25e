"""The command `tipforce`: finds the subcommand, loads only that one, and turns errors into messages and exit codes."""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import signal
import sys
from collections.abc import Sequence

from tipforce.errors import (
    EnvironmentLackError,
    InputError,
    NoResponseError,
    RefusedError,
    SdoAbortError,
    TipforceError,
)

# name -> (module with add_arguments(parser) and run(args) -> exit code, one line of help)
COMMANDS = {
    "demo": ("tipforce_tools.demo.command", "the main job with no hardware: calibrate, store, load, decode, compare"),
    "node": ("tipforce_tools.node", "run one fingertip node on a bus"),
    "scan": ("tipforce_tools.scan", "list the nodes on the bus"),
    "sdo": ("tipforce_tools.sdo", "read or write an object of a node"),
    "config": ("tipforce_tools.config", "apply or verify a configuration file (TOML or DCF)"),
    "calibrate": ("tipforce_tools.calibrate", "apply or verify a calibration file"),
    "dump": ("tipforce_tools.dump.command", "show frames as candump does, with --decode also their contact values"),
    "export": ("tipforce_tools.export", "write the EDS or the DBC from the object dictionary"),
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
    if not words or words[0] in ("-h", "--help", "help"):
        lines = (f"  {name:10} {summary}" for name, (_, summary) in COMMANDS.items())
        print(USAGE.format(commands="\n".join(lines)), end="")
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        from tipforce.dictionary.table import SOFTWARE_VERSION

        print(f"tipforce {SOFTWARE_VERSION}")
        return 0
    try:
        return _run(words[0], words[1:])
    except TipforceError as error:
        return _failed(str(error), _exit_code(error))
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader (head, less) has seen enough. Python would complain again when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _run(name: str, words: list[str]) -> int:
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 3)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(COMMANDS)}"
        return _failed(f"{name!r} is not a command; {hint}", 2)
    module_name, summary = COMMANDS[name]
    module = importlib.import_module(module_name)
    parser = argparse.ArgumentParser(prog=f"tipforce {name}", description=summary[0].upper() + summary[1:] + ".")
    module.add_arguments(parser)
    args = parser.parse_args(words)
    code: int = module.run(args)
    sys.stdout.flush()
    return code


def _exit_code(error: TipforceError) -> int:
    if isinstance(error.__cause__, PermissionError) or "not permitted" in str(error):
        return PERMISSION
    return next((code for kind, code in EXIT_CODES.items() if isinstance(error, kind)), 1)


def _failed(message: str, code: int) -> int:
    print(f"tipforce: {message}", file=sys.stderr)
    return code


def terminate_as_interrupt() -> None:
    """Let SIGTERM end a long-running command as Ctrl-C does, so that it closes what it opened."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)


if __name__ == "__main__":
    sys.exit(main())
