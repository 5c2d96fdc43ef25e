"""The script for zsh: a function for its completion system (compinit)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from tipforce_tools.completion.model import CAN, COMMAND, FILE, OBJECT, CommandLine, Flag, Value, object_names

_START = """\
#compdef tipforce
# made by `tipforce completion zsh`

_tipforce_can() {  # the CAN interfaces of this machine: ARPHRD_CAN is 280
    local place kind; local -a found
    for place in /sys/class/net/*(N); do
        read -r kind 2>/dev/null < $place/type && [[ $kind == 280 ]] && found+=(${place:t})
    done
    _wanted interfaces expl 'CAN interface' compadd -a found
}
"""


def script(lines: Sequence[CommandLine]) -> str:
    """The whole script."""
    names = "\n".join(f"        {name}" for name in object_names())
    commands = {line.path[0]: line.summary for line in lines if len(line.path) == 1}
    return "\n".join(
        [
            _START,
            f"_tipforce_objects() {{\n    local -a found=(\n{names}\n    )\n"
            "    _wanted objects expl 'object' compadd -a found\n}\n",
            *(_function(line) for line in lines),
            _chooser("_tipforce", commands, "command"),
            '\nif [[ $funcstack[1] == _tipforce ]]; then _tipforce "$@"; else compdef _tipforce tipforce; fi',
            "",
        ]
    )


def _name(path: Sequence[str]) -> str:
    return "_tipforce_at_" + "_".join(path)


def _function(line: CommandLine) -> str:
    if line.actions:
        return _chooser(_name(line.path), line.actions, "action")
    specs = [spec for flag in line.flags for spec in _specs(flag)]
    for number, value in enumerate(line.positionals):
        place = "*" if line.more and number == len(line.positionals) - 1 else str(number + 1)
        specs.append(_quoted(f"{place}:{_message(value)}:{_action(value)}"))
    body = " \\\n".join(f"        {spec}" for spec in specs)
    return f"{_name(line.path)}() {{\n    _arguments -S \\\n{body}\n}}\n"


def _chooser(name: str, choices: Mapping[str, str], what: str) -> str:
    """A function that completes one word of ``choices``, and leaves the words behind it to the function of that."""
    prefix = "_tipforce_at_" if what == "command" else f"{name}_"
    listed = "\n".join(f"            {_quoted(f'{key}:{text}')}" for key, text in choices.items())
    return f"""\
{name}() {{
    if (( CURRENT == 2 )); then
        local -a found=(
{listed}
        )
        _describe {what} found
    elif (( $+functions[{prefix}$words[2]] )); then
        shift words
        (( CURRENT -= 1 ))
        {prefix}$words[1]
    fi
}}
"""


def _specs(flag: Flag) -> list[str]:
    """One spec for each spelling; a flag that was given excludes the other spellings."""
    others = f"({' '.join(flag.names)})" if len(flag.names) > 1 else ""
    value = "" if flag.value is None else f":{_message(flag.value)}:{_action(flag.value)}"
    ends = {name: "" if flag.value is None else "=" if name.startswith("--") else "+" for name in flag.names}
    return [_quoted(f"{others}{name}{ends[name]}[{_text(flag.help)}]{value}") for name in flag.names]


def _text(help_text: str) -> str:
    return re.sub(r"([\[\]\\:])", r"\\\1", help_text)


def _message(value: Value) -> str:
    return " or ".join(sorted(value.sources)) or "value"


def _action(value: Value) -> str:
    parts = []
    if value.words:
        parts.append(f"({' '.join(value.words)})")
    for source, function in ((CAN, "_tipforce_can"), (OBJECT, "_tipforce_objects"), (FILE, "_files")):
        if source in value.sources:
            parts.append(function)
    if COMMAND in value.sources:
        return "_normal"
    if len(parts) < 2:
        return "".join(parts) or " "
    alternatives = [f'"{k}:{_message(value)}:{part}"' for k, part in enumerate(parts)]
    return f"{{_alternative {' '.join(alternatives)}}}"


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "'\\''") + "'"
