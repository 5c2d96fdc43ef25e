"""Names of objects by node: the fingertip's dictionary, or dictionaries of other devices."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
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


def eds_names(files: Iterable[tuple[int, str]], otherwise: Describe) -> Describe:
    """Return the names of nodes by their EDS or DCF, (node-id, file); ``otherwise`` for all other nodes.

    Raises InputError for a file that is no EDS.
    """
    from tipforce.eds.reader import read_eds

    known = {node_id: read_eds(path, node_id) for node_id, path in files}

    def found(node_id: int, index: int, sub: int) -> Description | None:
        if node_id not in known:
            return otherwise(node_id, index, sub)
        entry = known[node_id].entry(index, sub)
        if entry is None:
            return None
        return Description(entry.name, entry.name, entry.unit, entry.letter, entry.access)

    return found
