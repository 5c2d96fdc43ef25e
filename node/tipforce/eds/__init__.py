"""Devices of any manufacturer from their EDS or DCF (CiA 306): what the file says, and the device that it describes."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.eds.description import Description as Description
    from tipforce.eds.description import Entry as Entry
    from tipforce.eds.load import EdsWarning as EdsWarning
    from tipforce.eds.load import device_from_eds as device_from_eds
    from tipforce.eds.reader import read_eds as read_eds

_MODULES = {
    "device_from_eds": "load",
    "EdsWarning": "load",
    "read_eds": "reader",
    "Description": "description",
    "Entry": "description",
}
__all__ = [
    "Description",
    "EdsWarning",
    "Entry",
    "device_from_eds",
    "read_eds",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
