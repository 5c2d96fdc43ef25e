"""Checkouts of the product, and how its command line and the adapter run in one of them."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "nets"
LIMIT_S = 900
"""Of one command: it hangs."""


@dataclass(frozen=True)
class Tree:
    """A checkout, or the files of a commit under build/."""

    name: str
    folder: Path

    @classmethod
    def of(cls, ref: str) -> Tree:
        """The files of a git ref, made where they are missing."""
        sha = _git("rev-parse", "--short=9", f"{ref}^{{commit}}")
        folder = BUILD / "trees" / sha
        if not (folder / "pyproject.toml").exists():
            folder.mkdir(parents=True, exist_ok=True)
            archive = subprocess.run(["git", "archive", sha], cwd=ROOT, check=True, capture_output=True).stdout
            subprocess.run(["tar", "-x"], cwd=folder, input=archive, check=True)
        return cls(sha, folder)

    @cached_property
    def project(self) -> dict[str, Any]:
        """Its pyproject.toml, which says where the packages and the command line are."""
        return tomllib.loads((self.folder / "pyproject.toml").read_text())

    @property
    def code(self) -> str:
        """What `python -c` runs as its command line."""
        module, _, function = self.project["project"]["scripts"]["tipforce"].partition(":")
        return f"import sys; from {module} import {function} as main; sys.exit(main())"

    def environment(self) -> dict[str, str]:
        """Environment variables: the packages of this tree, and nothing of the person who runs the net."""
        home = BUILD / "home"
        home.mkdir(parents=True, exist_ok=True)
        folders = self.project["tool"]["hatch"]["build"]["dev-mode-dirs"]
        texts = (
            "TZ=UTC LANG=C.UTF-8 COLUMNS=120 NO_COLOR=1 MPLBACKEND=agg SOURCE_DATE_EPOCH=1700000000 PYTHONHASHSEED=0 "
            "OMP_NUM_THREADS=1 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
        )
        return dict(text.split("=") for text in texts.split()) | {
            "PATH": os.environ["PATH"],
            "HOME": str(home),
            "PYTHONPATH": os.pathsep.join([*(str(self.folder / name) for name in folders), str(ROOT)]),
            "NETS_MAIN": self.code.split("; ")[1],
        }

    def tipforce(self, words: list[str], cwd: Path, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
        """Run a command line in a process of its own."""
        return self._run([sys.executable, "-c", self.code, *words], cwd, stdin)

    def adapter(self, words: list[str], cwd: Path, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
        """Run adapter.py, which imports this tree's packages."""
        return self._run([sys.executable, "-m", "bench.nets.adapter", *words], cwd, stdin)

    def _run(self, words: list[str], cwd: Path, stdin: bytes) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            words, cwd=cwd, input=stdin, capture_output=True, check=False, env=self.environment(), timeout=LIMIT_S
        )


def run_lines(tree: Tree, lines: str, folder: Path, inputs: Path) -> None:
    """Run the command lines of a case in ``folder``, where ``in`` is ``inputs``, and store what they print.

    `cp FROM TO` copies, `rm FILE` removes, `< FILE` is stdin. A line that starts with @ goes to the adapter, with the
    lines | that follow.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "in").symlink_to(os.path.relpath(inputs, folder))
    for number, block in enumerate(filter(None, map(str.strip, re.split(r"\n(?!\s*\|)", lines))), 1):
        line, *talk = [part.strip() for part in block.split("\n")]
        text, _, source = line.partition(" < ")
        words, stdin = shlex.split(text), "\n".join(part[1:].strip() for part in talk).encode()
        if source:
            stdin = (folder / source).read_bytes()
        if words[0] == "cp":
            copy = shutil.copytree if (folder / words[1]).is_dir() else shutil.copy
            copy(folder / words[1], folder / words[2])
            continue
        if words[0] == "rm":
            (folder / words[1]).unlink(missing_ok=True)
            continue
        run = tree.adapter if words[0].startswith("@") else tree.tipforce
        done = run(words, folder, stdin)
        head = f"$ {line}\nexit {done.returncode}\n".encode()
        (folder / f"{number:02}.err").write_bytes(head + done.stderr)
        (folder / f"{number:02}.out").write_bytes(done.stdout)
    (folder / "in").unlink()


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
