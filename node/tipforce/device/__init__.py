"""A CANopen device as a pure state machine (CiA 301, 305): frames and time in, frames out. Runs on MicroPython."""

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.device.node import Application as Application
    from tipforce.device.node import Device as Device
    from tipforce.device.object_dictionary import ObjectDictionary as ObjectDictionary

_MODULES = {
    "Device": "node",
    "Application": "node",
    "ObjectDictionary": "object_dictionary",
}
__all__ = [
    "Application",
    "Device",
    "ObjectDictionary",
]


def __getattr__(name: str) -> object:
    """Public names are imported when they are first used."""
    if name in _MODULES:
        return getattr(__import__(__name__ + "." + _MODULES[name], None, None, (name,)), name)
    if sys.implementation.name == "micropython":  # it asks here before it looks for a submodule
        return __import__(__name__ + "." + name, None, None, (name,))
    raise AttributeError(name)
