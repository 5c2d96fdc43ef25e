"""Runs the examples of a page: ``>>>`` examples and ```` ```console ```` blocks, in the order of the page.

A line ``$ COMMAND`` of a console block is a call of ``shell(COMMAND)``, and the lines below it are what it prints.
``tipforce`` runs in this process, anything else in bash. ``<!-- test: STATEMENT -->`` is Python that the reader does
not see. A ```` ```toml ```` or other block whose info string has ``title="NAME"`` is written to that file."""

import contextlib
import doctest
import glob
import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tipforce_tools.cli.actions import parser_of
from tipforce_tools.cli.main import COMMANDS, command_parser, main

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
_BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$|^<!-- test: (.*?) -->$", re.MULTILINE | re.DOTALL)
_FILE = re.compile(r'title="([^"]+)"')
_COMMAND = re.compile(r"^\$ ((?:.*\\\n)*.*)\n?((?:(?!\$ ).*\n?)*)", re.MULTILINE)

Shell = Callable[[str], None]


class Terminal:
    """Runs command lines and prints their output, stderr last; ``echo $?`` prints the last exit code.

    ``flags`` are appended to every ``tipforce`` command: the bus that a reader names in a configuration file."""

    def __init__(self, flags: str = "") -> None:
        self.flags = shlex.split(flags)
        self.code = 0

    def __call__(self, line: str) -> None:
        """Run one command line."""
        line = line.replace("\\\n", " ")
        words = shlex.split(line, comments=True)
        if line == "echo $?":
            print(self.code)
        elif words[0] == "tipforce":
            own, sign, rest = re.fullmatch(r"(.*?)(?: ([|>]) (.*))?", line).groups()  # type: ignore[union-attr]
            out, err = self._tipforce([*_expanded(shlex.split(own, comments=True)[1:]), *self.flags])
            if sign:
                out = self._bash(rest if sign == "|" else f"cat > {rest}", out)
            print(out + err, end="")
        else:
            print(self._bash(line), end="")

    def _tipforce(self, words: list[str]) -> tuple[str, str]:
        out, err = io.TextIOWrapper(io.BytesIO(), write_through=True), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            self.code = main(words)
        out.seek(0)
        return out.read(), err.getvalue()

    def _bash(self, line: str, given: str = "") -> str:
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # the reader's venv is active
        environment = {**os.environ, "PATH": path}
        done = subprocess.run(
            ["bash", "-c", line], input=given, capture_output=True, text=True, timeout=60, check=False, env=environment
        )
        self.code = done.returncode
        return done.stdout + done.stderr


def _expanded(words: list[str]) -> Iterator[str]:
    for word in words:
        yield from sorted(glob.glob(word)) if "*" in word and glob.glob(word) else [word]


def examples(page: Path) -> list[doctest.Example]:
    """The examples of a page, in order, each with its line."""
    text = page.read_text()
    found: list[doctest.Example] = []
    for block in _BLOCK.finditer(text):
        info, body, hidden = block.groups()
        start = block.start(2) if hidden is None else block.start(3)
        line = text.count("\n", 0, start)
        if hidden is not None:
            found.append(doctest.Example(hidden + "\n", "", lineno=line))
        elif file := _FILE.search(info):
            found.append(doctest.Example(f"_ = Path({file[1]!r}).write_text({body!r})\n", "", lineno=line))
        elif info.split()[:1] == ["console"]:
            for command in _COMMAND.finditer(body):
                source = f"shell({command[1]!r})\n"
                found.append(doctest.Example(source, command[2], lineno=line + body.count("\n", 0, command.start())))
        elif info.split()[:1] in (["pycon"], ["python"]):
            for example in doctest.DocTestParser().get_examples(body, page.name):
                example.lineno += line
                found.append(example)
    return found


def run_page(page: Path, names: dict[str, Any]) -> doctest.TestResults:
    """Run the examples of a page in the working directory; ``names`` are in its Python."""
    found = examples(page)
    test = doctest.DocTest(
        found, {"__name__": "__main__", "Path": Path, "shell": Terminal(), **names}, page.name, str(page), 0, None
    )
    return doctest.DocTestRunner(optionflags=FLAGS).run(test)


def shell_lines(text: str, *languages: str) -> list[str]:
    """The lines of a text's blocks of sh, and of other languages, without comments."""
    blocks = [block[2] for block in _BLOCK.finditer(text) if block[2] and block[1].split(" ")[0] in ("sh", *languages)]
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [re.split(r" +# ", f"{line} # ")[0] for line in lines]


def command_lines(page: Path) -> list[str]:
    """The ``tipforce`` commands in a page's blocks of sh or of no language, without redirections and comments."""
    parts = [part.strip() for line in shell_lines(page.read_text(), "") for part in re.split(r" [|&>] | ?&$|;", line)]
    return [words for words in parts if words.startswith("tipforce ")]


def check_command(words: list[str]) -> None:
    """SystemExit or AssertionError for a `tipforce` command that does not exist or does not take these words."""
    if words[0] == "--completion":
        assert words[1:] in (["bash"], ["zsh"], ["fish"])
        return
    assert words[0] in COMMANDS, words
    place = COMMANDS[words[0]][0]
    parser = command_parser(words[0])
    if not isinstance(place, str):
        action = parser.parse_args(words[1:2]).action
        parser, words = parser_of(action, *place[action]), words[1:]
    parser.parse_args(words[1:])
