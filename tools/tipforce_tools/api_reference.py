"""The API reference: the docstrings of `tipforce` as HTML, by pdoc. `make docs` runs it.

python -m tipforce_tools.api_reference -o build/api
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import inspect
import pkgutil
import re
import sys
import typing
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

import tipforce
from tipforce.errors import EnvironmentLackError, TipforceError

PACKAGE = "tipforce"
_PRIVATE = re.compile(rf" for {PACKAGE}\.[\w.]*\b_(?!_)")


def module_names() -> list[str]:
    """Every public module of the import package, in order; none is imported but the packages."""
    found = pkgutil.walk_packages(tipforce.__path__, f"{PACKAGE}.")
    names = [PACKAGE, *(module.name for module in found)]
    return [name for name in names if not any(part.startswith("_") for part in name.split("."))]


def build(output: Path, names: Sequence[str] = ()) -> list[str]:
    """Write the pages of ``names`` (all, if empty) to ``output``; returns pdoc's warnings, a good build has none.

    Raises EnvironmentLackError without pdoc.
    """
    pdoc = _pdoc()
    chosen = list(names) or module_names()
    with _recorded_warnings() as found:
        _prepare(chosen)
        pdoc.render.configure(docformat="markdown", footer_text="tipforce")
        left_out = [f"!{name.replace('.', '[.]')}$" for name in module_names() if name not in chosen]
        pdoc.pdoc(PACKAGE, *left_out, output_directory=output)
    return found


def check_annotations(names: Sequence[str] = ()) -> list[str]:
    """What ``build`` would warn of in signatures and types, without the time that rendering takes."""
    pdoc = _pdoc()
    chosen = list(names) or module_names()
    with _recorded_warnings() as found:
        _prepare(chosen)
        for name in chosen:
            _walk(pdoc.doc.Module.from_name(name))
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Build; 1 if pdoc warned of anything, 3 if it is not there."""
    parser = argparse.ArgumentParser(prog="python -m tipforce_tools.api_reference", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("build/api"), metavar="DIR")
    args = parser.parse_args(words)
    try:
        found = build(args.output)
    except TipforceError as error:
        print(f"api_reference: {error}", file=sys.stderr)
        return 3
    for line in found:
        print(f"api_reference: {line}", file=sys.stderr)
    print(f"{args.output / 'index.html'}: {len(module_names())} modules, {len(found)} warnings")
    return 1 if found else 0


def _pdoc() -> ModuleType:
    try:
        import pdoc
    except ImportError:
        raise EnvironmentLackError('pdoc is not installed: pip install "tipforce[docs]"') from None
    module: ModuleType = pdoc
    return module


def _prepare(names: Sequence[str]) -> None:
    """Resolve what pdoc cannot: the annotations of a NamedTuple's fields stand in __new__, without their module."""
    for name in names:
        for _, kind in inspect.getmembers(importlib.import_module(name), inspect.isclass):
            if kind.__module__ == name and issubclass(kind, tuple) and hasattr(kind, "_fields"):
                kind.__new__.__annotations__ = typing.get_type_hints(kind)


def _walk(place: typing.Any) -> None:
    """Touch each signature and annotation once: pdoc resolves them when they are asked for."""
    for name, member in place.members.items():
        if name.startswith("_") and name != "__init__":
            continue
        if member.kind == "class" and member.taken_from[0] == place.modulename:
            _walk(member)
        elif member.kind == "function":
            _ = member.signature
        elif member.kind == "variable":
            _ = member.annotation_str


@contextlib.contextmanager
def _recorded_warnings() -> Iterator[list[str]]:
    """A list that has, afterwards, each warning once, in order."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield found
    # Nothing private is shown, but pdoc looks at it all the same.
    messages = dict.fromkeys(str(warning.message) for warning in caught)
    found.extend(message for message in messages if not _PRIVATE.search(message))


if __name__ == "__main__":
    sys.exit(main())
