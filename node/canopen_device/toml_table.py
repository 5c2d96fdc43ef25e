"""Read all TOML files of users (scene, hand, calibration, ...) as structs, strictly, with errors of one form: each
names the place, the value, and what is allowed."""

import datetime
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import msgspec

from canopen_device.errors import InputError
from canopen_device.visible_text import visible

T = TypeVar("T", bound=msgspec.Struct)

_DATES = (datetime.datetime, datetime.date, datetime.time)
"""TOML has these types itself: text is not converted to them."""


def read_table(path: str | Path, place: str) -> dict[str, Any]:
    """Return the content of a TOML file. Raises InputError if it cannot be read, is not UTF-8, or is not TOML."""
    import tomllib  # commands import this module even if they are given no file

    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))  # editors of Windows begin with a BOM
    except OSError as error:
        raise InputError(f"{place}: {error.strerror}") from error
    except UnicodeDecodeError:
        raise InputError(f"{place}: the file is not UTF-8") from None
    except ValueError as error:  # not TOML, a number of thousands of digits, a NUL in the path
        raise InputError(f"{place}: {error}") from None
    except RecursionError:
        raise InputError(f"{place}: brackets are nested too deeply") from None


def convert(kind: type[T], content: object, place: str, finite: bool = True) -> T:
    """Return ``content`` (from tomllib) as ``kind``; ``place`` is its name in messages.

    A field may be a number, a string, a list of these, a table of free keys with such values, a struct, or a list of
    structs (also among plain values), of which the key ``kind`` selects one of a tagged union. A struct without
    ``forbid_unknown_fields`` ignores unknown keys, unless one resembles a missing one. Raises InputError for an unknown
    key (with the nearest known one), a missing one, a wrong type, a value outside its limits, and a number that is not
    finite; ``finite`` False leaves that check, which values of free keys always need, to the caller."""
    if not isinstance(content, Mapping):
        raise InputError(f"{place} is {_shown(content)}: allowed is a table")
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    tag = kind.__struct_config__.tag_field
    missing = [name for name, field in fields.items() if field.required and name not in content]
    for key in content:
        if key in fields or key == tag:
            continue
        if kind.__struct_config__.forbid_unknown_fields or _near(key, missing):
            raise InputError(f"{_at(place, key)}: no such key; {_suggestion(key, fields)}")
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name in content:
            values[field.name] = _value(field.type, content[name], _at(place, name), finite)
        elif name in missing:
            expected = _choices(field.type).removeprefix("; ") or "it has no default"
            raise InputError(f"{_at(place, name)} is missing; {expected}")
    return kind(**values)


def _value(kind: Any, content: object, place: str, finite: bool) -> Any:
    if get_origin(kind) is dict and isinstance(content, Mapping):
        return {key: _leaf(get_args(kind)[1], item, _at(place, key), False) for key, item in content.items()}
    structs, many = _structs(kind)
    if not structs:
        return _leaf(kind, content, place, finite)
    if not many:
        return convert(structs[0], content, place, finite)
    plain = [option for option in _options(get_args(kind)[0]) if option not in structs]
    if not isinstance(content, list):
        form = "allowed is a list" if plain else f"write [[{place.rpartition(': ')[2]}]]"
        raise InputError(f"{place} is {_shown(content)}: {form}")
    return tuple(
        _leaf(get_args(kind)[0], item, at, finite)
        if plain and not isinstance(item, Mapping)
        else convert(_tagged(structs, item, at), item, at, finite)
        for item, at in [(item, f"{place}[{number}]") for number, item in enumerate(content, 1)]
    )


def _structs(kind: Any) -> tuple[list[type[msgspec.Struct]], bool]:
    if get_origin(kind) is tuple:
        return _structs(get_args(kind)[0])[0], True
    return [part for part in _options(kind) if isinstance(part, type) and issubclass(part, msgspec.Struct)], False


def _options(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (typing.Union, types.UnionType) else (kind,)


def _tagged(structs: list[type[msgspec.Struct]], item: object, place: str) -> type[msgspec.Struct]:
    tags = {str(struct.__struct_config__.tag): struct for struct in structs}
    if len(structs) == 1 and structs[0].__struct_config__.tag is None:
        return structs[0]
    named = item.get("kind") if isinstance(item, Mapping) else None
    if named is None:
        raise InputError(f"{_at(place, 'kind')} is missing; allowed: {', '.join(tags)}")
    if str(named) not in tags:
        raise InputError(f"{_at(place, 'kind')} is {_shown(named)}; {_suggestion(str(named), tags)}")
    return tags[str(named)]


def _leaf(kind: Any, content: object, place: str, finite: bool) -> Any:
    if finite and not _finite(content):
        raise InputError(f"{place} is {_shown(content)}: allowed are finite numbers")
    texts = content if isinstance(content, list) else [content]
    if any(visible(text) != text for text in texts if isinstance(text, str)):
        raise InputError(f"{place} is {_shown(content)}: allowed is one line without control characters")
    try:
        return msgspec.convert(content, kind, builtin_types=_DATES)
    except msgspec.ValidationError as error:
        # TOML has tables for msgspec's objects, and no null.
        text = re.sub(r"`([^`]*)`", lambda m: m[1].replace("object", "table").replace(" | null", ""), str(error))
        text = text.replace(" - at $", " at ")
        raise InputError(f"{place} is {_shown(content)}: {text[0].lower()}{text[1:]}{_choices(kind)}") from None


def _finite(content: object) -> bool:
    if isinstance(content, list):
        return all(_finite(item) for item in content)
    return not isinstance(content, float) or math.isfinite(content)


def _choices(kind: Any) -> str:
    if get_origin(kind) is typing.Literal:
        return f"; allowed: {', '.join(map(str, get_args(kind)))}"
    return next(filter(None, map(_choices, get_args(kind))), "")


def _suggestion(word: str, known: Mapping[str, object]) -> str:
    near = _near(word, known)
    return (f"did you mean {near}? " if near else "") + f"allowed: {', '.join(known)}"


def _near(word: str, known: Iterable[str]) -> str:
    import difflib

    return next(iter(difflib.get_close_matches(word, known, 1)), "")


def _at(place: str, key: str) -> str:
    return f"{place}.{key}" if ": " in place else f"{place}: {key}"


def _shown(content: object) -> str:
    text = content.isoformat() if isinstance(content, _DATES) else repr(content)
    return text if len(text) <= 60 else text[:57] + "..."
