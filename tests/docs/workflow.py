"""A GitHub workflow file as far as it is used here: jobs, steps, and the commands in them. No YAML package is needed.

It understands mappings by indentation, lists of mappings, ``run: |`` blocks, and refuses tabs and odd indentation,
where a real parser would refuse too.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Step:
    """One step: its keys, and the lines of its ``run``."""

    keys: dict[str, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


@dataclass
class Workflow:
    """Top-level keys, names of jobs, and all steps in order."""

    keys: list[str]
    jobs: list[str]
    steps: list[Step]


_KEY = re.compile(r"^( *)(- )?([A-Za-z_-]+):(?: (.*))?$")


def read_workflow(path: Path) -> Workflow:
    """Read a file; ValueError naming the line for what is not understood."""
    found = Workflow([], [], [])
    block_indent = None  # of the key whose `|` block we are in
    for number, line in enumerate(path.read_text().splitlines(), 1):
        indent = len(line) - len(line.lstrip())
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if block_indent is not None and indent > block_indent:
            found.steps[-1].lines.append(line.strip())
            continue
        block_indent = None
        match = _KEY.match(line)
        if match is None or "\t" in line or indent % 2:
            raise ValueError(f"{path.name}:{number}: {line!r}")
        dash, key, value = match[2] or "", match[3], match[4] or ""
        _place(found, indent, dash, key, value)
        if value == "|":
            block_indent = indent + len(dash)
        elif key == "run":
            found.steps[-1].lines.append(value)
    return found


def _place(found: Workflow, indent: int, dash: str, key: str, value: str) -> None:
    if indent == 0:
        found.keys.append(key)
    elif indent == 2 and found.keys[-1] == "jobs":
        found.jobs.append(key)
    elif dash:
        found.steps.append(Step())
    if dash or (indent == 8 and found.steps):
        found.steps[-1].keys[key] = value


def commands(workflow: Workflow, program: str) -> list[list[str]]:
    """The words behind ``program`` wherever a line of a ``run`` calls it, up to what ends a command."""
    calls = []
    for step in workflow.steps:
        for line in step.lines:
            for part in re.split(r"&&|\|\||[;|&>]", line):
                words = shlex.split(part)
                if words[:1] == [program]:
                    calls.append(words[1:])
    return calls
