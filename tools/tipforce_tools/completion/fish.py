"""The script for fish (3.1 or newer)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tipforce_tools.completion.model import CAN, COMMAND, FILE, OBJECT, CommandLine, Flag, Value, object_names

_START = """\
# fish completion for tipforce; made by `tipforce completion fish`

function __tipforce_at --description 'whether the command line is that of these words'
    set -l words (commandline -opc)[2..]
    set -l wanted (count $argv)
    test (count $words) -ge $wanted; and test "$words[1..$wanted]" = "$argv"
end

function __tipforce_none --description 'whether there is no command yet'
    test (count (commandline -opc)) -eq 1
end

function __tipforce_count --description 'whether so many words stand behind tipforce'
    test (count (commandline -opc)) -eq (math $argv[1] + 1)
end

function __tipforce_can --description 'the CAN interfaces of this machine'
    for place in /sys/class/net/*
        test (cat $place/type 2>/dev/null)x = 280x; and basename $place
    end
end

complete -c tipforce -f
complete -c tipforce -n __tipforce_none -l help -d 'list the commands'
complete -c tipforce -n __tipforce_none -l version -d 'print the version'
"""


def script(lines: Sequence[CommandLine]) -> str:
    """The whole script."""
    objects = f"set -g __tipforce_objects {' '.join(object_names())}\n"
    return "\n".join([_START, objects, *(text for line in lines for text in _line(line))]) + "\n"


def _line(line: CommandLine) -> Iterator[str]:
    path = " ".join(line.path)
    before = " ".join(line.path[:-1])
    at = f"__tipforce_at {before}; and __tipforce_count 1" if before else "__tipforce_none"
    yield f"\ncomplete -c tipforce -n {_quoted(at)} -a {line.path[-1]} -d {_quoted(line.summary)}"
    here = f"complete -c tipforce -n {_quoted(f'__tipforce_at {path}')}"
    if line.actions:
        yield f"{here} -s h -l help -d 'list the actions'"
        return
    for flag in line.flags:
        yield f"{here} {_flag(flag)}"
    for value in dict.fromkeys(line.positionals):  # which of the words it is, is not counted
        if offers := _offers(value):
            yield f"{here} {offers}"


def _flag(flag: Flag) -> str:
    spelled = []
    for name in flag.names:
        spelled.append(f"-l {name[2:]}" if name.startswith("--") else f"-{'s' if len(name) == 2 else 'o'} {name[1:]}")
    if flag.value is not None:
        spelled.append("-r" if FILE in flag.value.sources else "-x")
        spelled.append(_offers(flag.value))
    return " ".join(filter(None, [*spelled, f"-d {_quoted(flag.help)}"]))


def _offers(value: Value) -> str:
    words = list(value.words)
    for source, text in (
        (CAN, "(__tipforce_can)"),
        (OBJECT, "$__tipforce_objects"),
        (COMMAND, "(__fish_complete_subcommand)"),
    ):
        if source in value.sources:
            words.append(text)
    parts = ["-F"] if FILE in value.sources else []
    return " ".join([*parts, f"-a {_quoted(' '.join(words))}"] if words else parts)


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
