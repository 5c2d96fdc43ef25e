"""The script for bash (4 or newer). It needs no other package; words are taken from the line as it was typed."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence

from tipforce_tools.completion.model import CAN, COMMAND, FILE, OBJECT, CommandLine, Value, object_names

_START = """\
# bash completion for tipforce; made by `tipforce completion bash`

_tipforce_words() {  # the words that begin as what was typed; readline has already taken what stands before a colon
    local word skip=${cur%"${cur##*:}"}
    for word in "$@"; do
        [[ $word == "$cur"* ]] && COMPREPLY+=("${word#"$skip"}")
    done
}

_tipforce_files() {
    local name
    compopt -o filenames 2>/dev/null
    while IFS= read -r name; do COMPREPLY+=("$name"); done < <(compgen -f -- "$cur")
}

_tipforce_can() {  # the CAN interfaces of this machine: ARPHRD_CAN is 280
    local place kind
    for place in /sys/class/net/*; do
        read -r kind 2>/dev/null < "$place/type" && [[ $kind == 280 ]] && _tipforce_words "${place##*/}"
    done
}

_tipforce_command() {
    local name
    while IFS= read -r name; do COMPREPLY+=("$name"); done < <(compgen -c -- "$cur")
    _tipforce_files
}
"""

_END = """\
_tipforce() {
    local line=${COMP_LINE:0:COMP_POINT} words cur prev path place number=0 k
    read -ra words <<< "$line"
    [[ $line == *[[:space:]] ]] && words+=("")
    cur=${words[${#words[@]} - 1]} prev=""
    COMPREPLY=()
    if (( ${#words[@]} <= 2 )); then _tipforce_words $_tipforce_commands; return; fi
    path=${words[1]} k=2
    if [[ " $_tipforce_with_actions " == *" $path "* ]]; then
        if (( ${#words[@]} == 3 )); then _tipforce_value "$path" action; return; fi
        path+=" ${words[2]}" k=3
    fi
    for (( ; k < ${#words[@]} - 1; k++ )); do  # how many positional words came before
        if [[ -n $prev ]]; then prev=""
        elif _tipforce_takes_value "$path" "${words[k]}"; then prev=${words[k]}
        elif [[ ${words[k]} != -?* ]]; then (( number += 1 ))
        fi
    done
    if [[ -z $prev && $cur == --*=* ]]; then
        prev=${cur%%=*} cur=${cur#*=}
    fi
    if [[ -n $prev ]]; then _tipforce_value "$path" "$prev"
    elif [[ $cur == -* ]]; then _tipforce_value "$path" flags
    else
        _tipforce_place "$path" "$number"
        _tipforce_value "$path" "$place"
    fi
}

complete -F _tipforce tipforce
"""


def script(lines: Sequence[CommandLine]) -> str:
    """The whole script."""
    commands = [line.path[0] for line in lines if len(line.path) == 1]
    with_actions = [line.path[0] for line in lines if line.actions]
    parts = [
        _START,
        f"_tipforce_commands={shlex.quote(' '.join([*commands, '--help', '--version']))}",
        f"_tipforce_with_actions={shlex.quote(' '.join(with_actions))}\n",
        _function("takes_value", (_takes_value(line) for line in lines), "*) return 1 ;;"),
        _function("place", (_place(line) for line in lines), "*) place=none ;;"),
        _function("value", (case for line in lines for case in _values(line))),
        _END,
    ]
    return "\n".join(parts)


def _function(name: str, cases: Iterable[str], default: str = "") -> str:
    body = "\n".join(f"        {case}" for case in (*cases, default) if case)
    return f'_tipforce_{name}() {{\n    case "$1 $2" in\n{body}\n    esac\n}}\n'


def _takes_value(line: CommandLine) -> str:
    flags = [name for flag in line.flags if flag.value is not None for name in flag.names]
    return f"{_patterns(line, flags)}) return 0 ;;" if flags else ""


def _place(line: CommandLine) -> str:
    """`'sdo '*) place=...`: which of the positional words number $2 is."""
    last = len(line.positionals) - 1
    if last < 0:
        return ""
    if line.more:
        return f"{_path(line)}*) place=$(( $2 < {last} ? $2 : {last} )) ;;"
    return f"{_path(line)}*) (( $2 <= {last} )) && place=$2 || place=none ;;"


def _values(line: CommandLine) -> Iterable[str]:
    if line.actions:
        yield f"{_patterns(line, ['action'])}) _tipforce_words {' '.join([*line.actions, '--help'])} ;;"
        return
    names = [name for flag in line.flags for name in flag.names]
    yield f"{_patterns(line, ['flags'])}) _tipforce_words {' '.join(names)} ;;"
    for flag in line.flags:
        if flag.value is not None and (offers := _offers(flag.value)):
            yield f"{_patterns(line, flag.names)}) {offers} ;;"
    for number, value in enumerate(line.positionals):
        if offers := _offers(value):
            yield f"{_patterns(line, [str(number)])}) {offers} ;;"


def _patterns(line: CommandLine, words: Iterable[str]) -> str:
    return "|".join(shlex.quote(f"{' '.join(line.path)} {word}") for word in words)


def _path(line: CommandLine) -> str:
    return shlex.quote(f"{' '.join(line.path)} ")


def _offers(value: Value) -> str:
    words = list(value.words)
    if OBJECT in value.sources:
        words += object_names()
    offers = [f"_tipforce_words {' '.join(map(shlex.quote, words))}"] if words else []
    offers += [
        f"_tipforce_{source}{'s' if source == FILE else ''}"
        for source in (CAN, FILE, COMMAND)
        if source in value.sources
    ]
    return "; ".join(offers)
