"""A CANopen slave for any project (CiA 301, 305, 306): copy this folder.

- ``core``: the device as a pure state machine, frames and time in, frames out; runs on MicroPython, needs nothing
- ``eds``: devices of any manufacturer from their EDS, DCF or XDD; needs nothing but the standard library
- ``running``: the loop that runs devices, the ports to a bus, the store on disk; python-can for a bus that is not
  SocketCAN, msgpack for a bus by UDP multicast
- ``machine``: simulated devices with values, signals, behaviour and faults; python-can, msgspec for machines in TOML

    from canopen_device import device_from_eds, simulated_device

    device = device_from_eds("drive.eds", 5)
    frames, next_due_us = device.step(now_us, received)             # no thread, clock or socket inside
    with simulated_device("drive.eds", 5, "can0") as drive:         # on a bus, for tests of a master
        drive[0x6064] = 100
"""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.core.node import Application as Application
    from canopen_device.core.node import Device as Device
    from canopen_device.core.object_dictionary import ObjectDictionary as ObjectDictionary
    from canopen_device.eds.load import EdsWarning as EdsWarning
    from canopen_device.eds.load import device_from_eds as device_from_eds
    from canopen_device.errors import CanopenDeviceError as CanopenDeviceError
    from canopen_device.errors import InputError as InputError
    from canopen_device.machine.device import SimulatedDevice as SimulatedDevice
    from canopen_device.machine.running import simulated_device as simulated_device
else:
    __getattr__, __dir__, __all__ = lazy(globals())
