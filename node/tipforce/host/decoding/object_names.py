"""Names of objects by node: the fingertip's dictionary, or dictionaries of other devices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeAlias

from tipforce.dictionary import types
from tipforce.dictionary.names import Description, describe

if TYPE_CHECKING:
    import canopen

Describe: TypeAlias = Callable[[int, int, int], Description | None]
"""(node-id, index, sub-index) -> name, unit and type of the object, or None."""


def fingertip_names(gauges: int = 3) -> Describe:
    """Return the names of fingertips with so many gauges."""
    return lambda _node_id, index, sub: describe(index, sub, gauges)


def dictionary_names(dictionaries: Mapping[int, canopen.ObjectDictionary], otherwise: Describe) -> Describe:
    """Return the names by node-id of these dictionaries, read from EDS files; ``otherwise`` for all other nodes."""

    def found(node_id: int, index: int, sub: int) -> Description | None:
        dictionary = dictionaries.get(node_id)
        if dictionary is None:
            return otherwise(node_id, index, sub)
        variable = dictionary.get_variable(index, sub)
        letter = None if variable is None else types.LETTER_OF_CODE.get(variable.data_type or 0)
        if variable is None or letter is None:
            return None
        return Description(variable.name, variable.qualname, variable.unit, letter, variable.access_type)

    return found
