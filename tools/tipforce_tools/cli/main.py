"""Entry point of `tipforce`: import the chosen command only, turn errors into messages and exit codes."""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from canopen_device.visible_text import visible
from tipforce import errors
from tipforce.errors import TipforceError
from tipforce_tools.cli.output import visible_streams

if TYPE_CHECKING:
    from tipforce_tools.cli.actions import Actions, CommandParser

_CALIBRATE = {
    "fit": ("calibrate.fit:fit", "fit a calibration to readings under known loads"),
    "apply": ("calibrate.fit:apply", "write a calibration file to a node, verify and store it"),
    "guide": ("calibrate.guide", "calibrate a node weight by weight and store the result; resumable"),
    "verify": ("calibrate.fit:verify", "compare a calibration file with that of a node"),
    "budget": ("calibrate.budget", "compute the error budget of P, phi and theta by cause"),
}
_DATASET = {
    "show": ("dataset:show", "print what a dataset holds"),
    "verify": ("dataset:verify", "compare the SHA-256 of each file"),
    "compact": ("dataset:compact", "join the files of a day; all get the same columns"),
    "sql": ("dataset:sql", "query a dataset with DuckDB"),
}
_DESIGN = {
    "table": ("design.tables:table", "recompute the paper's tables and figures, beside the printed values"),
    "sweep": ("design.tables:sweep", "compute condition number and noise over a dimension or a gauge shift"),
    "optimise": ("design.optimise", "search better dimensions and gauge positions"),
}
_FIRMWARE = {
    "show": ("network.nodes:firmware_show", "print the program of each node, and why an update failed"),
    "install": ("network.nodes:firmware_install", "install a program on nodes with program slots"),
}

# group -> name -> (place below tipforce_tools, or the actions with a place each: ``actions.Actions``; help in a line)
GROUPS: dict[str, dict[str, tuple[str | Actions, str]]] = {
    "try": {
        "demo": ("demo", "calibrate, load and compare simulated nodes; needs no hardware"),
        "run": ("scene", "run a scene: nodes, loads, faults and a recording in TOML"),
        "vcan": ("vcan", "run a command where vcan interfaces exist"),
    },
    "bus": {
        "scan": ("network.nodes:scan", "list the nodes on the bus"),
        "read": ("network.nodes:read", "read the contact of fingers, with its uncertainty"),
        "monitor": ("monitor", "show a live table of the nodes on a bus or in a log"),
        "sdo": ("network.sdo", "read or write one object of a node, or read all objects"),
        "nmt": ("network.nodes:nmt", "start, stop or reset nodes, and wait for their heartbeats"),
        "lss": ("network.nodes:lss", "find unconfigured nodes and assign node-ids (CiA 305)"),
        "config": ("network.config", "show, apply, compare or save the settings of a node"),
        "tare": ("network.nodes:tare", "set the present force as zero, show the tare, or clear it"),
        "firmware": (_FIRMWARE, "show or install the program of nodes with program slots"),
    },
    "finger and hand": {
        "calibrate": (_CALIBRATE, "fit a calibration, write it to a node, verify it, budget its error"),
        "estimate": ("estimate", "compute contact from gauge readings, with its uncertainty"),
        "hand": ("network.hand", "check, commission and run a hand defined in TOML"),
        "view": ("view", "serve a web page with the force on each fingertip"),
        "ros2": ("ros2", "publish forces and contacts as ROS 2 topics, without ROS"),
        "node": ("node:node", "run one fingertip node on a CAN bus"),
    },
    "logs": {
        "dump": ("dump", "print frames as candump does, with --decode their meaning"),
        "log": ("log", "record frames to a file that canplayer and Wireshark read"),
        "replay": ("replay", "send the frames of a log with their recorded timing"),
        "decode": ("decode", "convert logs to contact: CSV, JSON lines, Parquet, MCAP"),
        "dataset": (_DATASET, "show, verify, compact and query a dataset of `tipforce decode`"),
        "plot": ("plot", "plot the contact, gauges and faults of a log"),
    },
    "develop": {
        "simulate": ("node:simulate", "simulate CANopen devices from their EDS, or a machine in TOML"),
        "conformance": ("conformance", "test a CANopen device against the CiA standards, by clause"),
        "export": ("export", "write EDS, DBC, DCF, or C for firmware, from the dictionary"),
        "design": (_DESIGN, "recompute the paper's tables, sweep and optimise the structure"),
        "report": ("report", "measure error against run time, and check extreme cases"),
        "doctor": ("doctor", "find what this machine and its bus lack"),
    },
}
COMMANDS = {name: entry for commands in GROUPS.values() for name, entry in commands.items()}

EXIT_CODES: dict[type[TipforceError], int] = {
    errors.LogError: 1, errors.DuplicateNodeError: 1, errors.InputError: 2, errors.NoResponseError: 5,
    errors.EnvironmentLackError: 2, errors.SdoAbortError: 11, errors.RefusedError: 12, errors.WriteError: 1,
}  # fmt: skip
PERMISSION, INTERRUPTED = 9, 130
EXIT_TEXTS = {
    0: "ok", 1: "a check or a write failed, or a log is damaged", 2: "usage", 5: "no response",
    PERMISSION: "permission", 11: "SDO abort", 12: "the device refused", INTERRUPTED: "interrupted",
}  # fmt: skip

TOP_FLAGS = ("--help", "--help-bus", "--completion", "--version")
USAGE = """usage: tipforce COMMAND [options]
{commands}

COMMAND --help: its options; --help-bus: those that commands share; --completion bash|zsh|fish; --version
exit codes: {codes}
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return the exit code. Errors that a user can cause print no traceback."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Before numpy is imported: for small matrices the threads of BLAS only wait, and cost 0.1 s of processor time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Before pyarrow is: its own allocator returns memory between the parts of a log, and clears it again for the next.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    # The null device for each standard stream that is closed (`>&-`), so that no file gets its descriptor.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr: characters that its encoding lacks
    with visible_streams():
        try:
            code = _answer(words)
            sys.stdout.flush()
            return code
        except TipforceError as error:
            return _failed(str(error), _exit_code(error))
        except KeyboardInterrupt:
            return INTERRUPTED
        except BrokenPipeError:
            # The reader (head, less) closed the pipe. Python would report it again when it flushes stdout at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        except OSError as error:  # stdout on a full disk, a file that was removed
            return _failed(str(error), PERMISSION if isinstance(error, PermissionError) else 1)
        finally:
            if argv is None:
                gc.freeze()  # Python looks for garbage when it exits, too: 0.02 s with numpy


def _answer(words: list[str]) -> int:
    first = words[0] if words else ""
    if first in ("", "-h", "--help", "help"):
        width = max(map(len, COMMANDS))
        lines = [""]
        for group, commands in GROUPS.items():
            lines += [f"{group}:", *(f"  {name:{width}}  {summary}" for name, (_, summary) in commands.items())]
        codes = ", ".join(f"{code} {text}" for code, text in EXIT_TEXTS.items())
        print(USAGE.format(commands="\n".join(lines), codes=codes), end="")
        return 0 if first else 2
    if first in ("-V", "--version"):
        from tipforce.dictionary.table import SOFTWARE_VERSION

        print(f"tipforce {SOFTWARE_VERSION}")
    elif first == "--help-bus":
        from tipforce_tools.cli.actions import shared_help

        print(shared_help(), end="")
    elif first.partition("=")[0] == "--completion":
        from tipforce_tools.cli.completion import script

        print(script(first.partition("=")[2] or "".join(words[1:2]), all_parsers()), end="")
    else:
        try:
            return _run(first, words[1:])
        except SystemExit:
            sys.stdout.flush()  # argparse's help: detect a closed pipe here, not when Python exits
            raise
    return 0


def _run(name: str, words: list[str]) -> int:
    if name not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(name, [*COMMANDS, *TOP_FLAGS], 3, cutoff=0.7)
        hint = f"did you mean {' or '.join(near)}?" if near else f"commands: {', '.join(COMMANDS)}"
        return _failed(f"{name!r} is not a command; {hint}", 2)
    import signal

    from tipforce_tools.cli import common
    from tipforce_tools.cli.actions import check_files, functions, parser_of

    place, parser = COMMANDS[name][0], command_parser(name)
    if not isinstance(place, str):
        action = parser.parse_args(words[:1]).action
        parser, words, place = parser_of(f"{name} {action}", *place[action]), words[1:], place[action][0]
    # Flags may come between the positional words, but not inside another program's command line.
    passes_on = any(action.nargs == "..." for action in parser._actions)  # argparse.REMAINDER
    args = parser.parse_args(words) if passes_on else parser.parse_intermixed_args(words)
    check_files(parser, args)
    common.OUTPUT.set_up(args)
    with suppress(ValueError):  # not the main thread, which alone receives signals
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, so that a command closes what it opened
    return functions(place)[1](args)


def all_parsers() -> dict[str, tuple[str, CommandParser]]:
    """Return summary and parser of every command."""
    return {name: (summary, command_parser(name)) for name, (_, summary) in COMMANDS.items()}


def command_parser(name: str) -> CommandParser:
    """Return the parser of the command ``name`` of COMMANDS."""
    from tipforce_tools.cli.actions import parser_of

    return parser_of(name, *COMMANDS[name])


def _exit_code(error: TipforceError) -> int:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, PermissionError):
            return PERMISSION
        cause = cause.__cause__ or cause.__context__  # "from None" hides the context in print only
    return next((code for kind, code in EXIT_CODES.items() if isinstance(error, kind)), 1)


def _failed(message: str, code: int) -> int:
    print(f"tipforce: {visible(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
