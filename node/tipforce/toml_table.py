"""TOML files as structs, strictly: each complaint names the place, the value, and what is allowed.

Files that people write (a scene, a hand) are read by this one reader, so that their mistakes are told alike.
"""

from __future__ import annotations

import math
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import msgspec

from tipforce.errors import InputError

T = TypeVar("T", bound=msgspec.Struct)


def read_table(path: str | Path, place: str) -> dict[str, Any]:
    """What a TOML file holds. Raises InputError for one that can't be read, is not UTF-8, or is no TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{place}: {error.strerror}") from error
    except UnicodeDecodeError:
        raise InputError(f"{place}: the file is not UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{place}: {error}") from None


def convert(kind: type[T], content: object, place: str) -> T:
    """``content`` (what tomllib gave) as ``kind``; ``place`` is how the message calls it ("scenes/x.toml").

    A field may be a number, a string, a list of these, a struct, or a list of structs; where a list holds a union of
    structs, each with a tag, the key ``kind`` says which. Raises InputError for an unknown key (with the nearest known
    one), a missing one, a wrong type, a value outside its limits, and a number that is not finite.
    """
    if not isinstance(content, Mapping):
        raise InputError(f"{place} is {_shown(content)}: allowed is a table")
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    tag = kind.__struct_config__.tag_field
    for key in content:
        if key not in fields and key != tag:
            raise InputError(f"{_at(place, key)}: no such key; {_suggestion(key, fields)}")
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name in content:
            values[field.name] = _value(field.type, content[name], _at(place, name))
        elif field.required:
            raise InputError(f"{_at(place, name)} is missing; {_expected(field.type)}")
    return kind(**values)


def _value(kind: Any, content: object, place: str) -> Any:
    structs, many = _structs(kind)
    if not structs:
        return _leaf(kind, content, place)
    if not many:
        return convert(structs[0], content, place)
    if not isinstance(content, list):
        raise InputError(f"{place} is {_shown(content)}: write [[{place.rpartition(': ')[2]}]]")
    return tuple(convert(_tagged(structs, item, at), item, at) for item, at in _numbered(content, place))


def _numbered(items: list[object], place: str) -> list[tuple[object, str]]:
    return [(item, f"{place}[{number}]") for number, item in enumerate(items, 1)]


def _structs(kind: Any) -> tuple[list[type[msgspec.Struct]], bool]:
    """The structs that a field's type speaks of, and whether it holds many; none for a plain value."""
    if get_origin(kind) is tuple:
        return _structs(get_args(kind)[0])[0], True
    options = get_args(kind) if get_origin(kind) in (typing.Union, types.UnionType) else (kind,)
    return [option for option in options if isinstance(option, type) and issubclass(option, msgspec.Struct)], False


def _tagged(structs: list[type[msgspec.Struct]], item: object, place: str) -> type[msgspec.Struct]:
    tags = {str(struct.__struct_config__.tag): struct for struct in structs}
    if len(structs) == 1 and structs[0].__struct_config__.tag is None:
        return structs[0]
    found = item.get("kind") if isinstance(item, Mapping) else None
    if found is None:
        raise InputError(f"{_at(place, 'kind')} is missing; allowed: {', '.join(tags)}")
    if found not in tags:
        raise InputError(f"{_at(place, 'kind')} is {_shown(found)}; {_suggestion(str(found), tags)}")
    return tags[str(found)]


def _leaf(kind: Any, content: object, place: str) -> Any:
    if not _finite(content):
        raise InputError(f"{place} is {_shown(content)}: allowed are finite numbers")
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        told = str(error).replace("`", "").replace(" - at $", " at ")
        raise InputError(f"{place} is {_shown(content)}: {told[0].lower()}{told[1:]}{_choices(kind)}") from None


def _finite(content: object) -> bool:
    if isinstance(content, list):
        return all(_finite(item) for item in content)
    return not isinstance(content, float) or math.isfinite(content)


def _choices(kind: Any) -> str:
    """The words that are allowed, where there is a list of them."""
    if get_origin(kind) is typing.Literal:
        return f"; allowed: {', '.join(map(str, get_args(kind)))}"
    return next((found for found in map(_choices, get_args(kind)) if found), "")


def _expected(kind: Any) -> str:
    choices = _choices(kind)
    return choices[2:] if choices else "it has no default"


def _suggestion(word: str, known: Mapping[str, object]) -> str:
    import difflib

    near = difflib.get_close_matches(word, known, 1)
    return (f"did you mean {near[0]}? " if near else "") + f"allowed: {', '.join(known)}"


def _at(place: str, key: str) -> str:
    return f"{place}.{key}" if ": " in place else f"{place}: {key}"


def _shown(content: object) -> str:
    text = repr(content)
    return text if len(text) <= 60 else text[:57] + "..."
