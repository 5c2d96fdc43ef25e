"""The application on the device: gauge readings to strain, force, contact and CiA 404 objects. Runs on MicroPython."""

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.fingertip.filters import FIRST_ORDER as FIRST_ORDER
    from tipforce.fingertip.filters import MOVING_AVERAGE as MOVING_AVERAGE
    from tipforce.fingertip.filters import REPEATING_AVERAGE as REPEATING_AVERAGE
    from tipforce.fingertip.filters import algorithm as algorithm
    from tipforce.fingertip.node import fingertip_node as fingertip_node
    from tipforce.fingertip.source import Reading as Reading
    from tipforce.fingertip.source import Source as Source

_MODULES = {
    "fingertip_node": "node", "Source": "source", "Reading": "source", "algorithm": "filters",
    "MOVING_AVERAGE": "filters", "REPEATING_AVERAGE": "filters", "FIRST_ORDER": "filters",
}  # fmt: skip
__all__ = ["FIRST_ORDER", "MOVING_AVERAGE", "REPEATING_AVERAGE", "Reading", "Source", "algorithm", "fingertip_node"]


def __getattr__(name: str) -> object:
    """Public names are imported when they are first used."""
    if name in _MODULES:
        return getattr(__import__(__name__ + "." + _MODULES[name], None, None, (name,)), name)
    if sys.implementation.name == "micropython":  # it asks here before it looks for a submodule
        return __import__(__name__ + "." + name, None, None, (name,))
    raise AttributeError(name)
