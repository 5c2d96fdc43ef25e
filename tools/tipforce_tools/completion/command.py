"""`tipforce completion bash|zsh|fish`: arguments, and nothing else."""

import argparse

from tipforce_tools.cli import common

DESCRIPTION = """\
Print the script that lets a shell complete commands, flags, choices, files, CAN interfaces and object names of
`tipforce`. The script is static: a TAB starts no Python. Print it again after an update.
"""
EPILOG = """\
  source <(tipforce completion bash)                                       this shell only
  tipforce completion bash > ~/.local/share/bash-completion/completions/tipforce
  tipforce completion zsh > "${fpath[1]}/_tipforce"                        any folder of $fpath, before compinit
  tipforce completion fish > ~/.config/fish/completions/tipforce.fish
"""
SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `tipforce completion` to `parser`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = DESCRIPTION
    parser.epilog = EPILOG
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help="bash, zsh or fish")
    common.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print the script: 0."""
    from tipforce_tools.completion.script import script

    text = script(args.shell)
    if args.json:
        common.print_json({"shell": args.shell, "script": text})
    else:
        print(text, end="")
    return 0
