"""Devices of any manufacturer from their EDS or DCF (CiA 306): what the file says, and the device that it describes."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.eds.description import Description as Description
    from canopen_device.eds.description import Entry as Entry
    from canopen_device.eds.load import EdsWarning as EdsWarning
    from canopen_device.eds.load import device_from_eds as device_from_eds
    from canopen_device.eds.reader import read_eds as read_eds
else:
    __getattr__, __dir__, __all__ = lazy(globals())
