"""Simulate CANopen devices of any manufacturer: from their EDS, with values, behaviour and faults of your own."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.machine.cia402 import Drive as Drive
    from canopen_device.machine.device import DeviceApplication as DeviceApplication
    from canopen_device.machine.device import SimulatedDevice as SimulatedDevice
    from canopen_device.machine.running import device_from_file as device_from_file
    from canopen_device.machine.running import shipped_eds as shipped_eds
    from canopen_device.machine.running import simulated_device as simulated_device
    from canopen_device.machine.running import simulated_devices as simulated_devices
    from canopen_device.machine.signals import Follows as Follows
    from canopen_device.machine.signals import Ramp as Ramp
    from canopen_device.machine.signals import RandomWalk as RandomWalk
    from canopen_device.machine.signals import Recorded as Recorded
    from canopen_device.machine.signals import Sine as Sine
    from canopen_device.machine.signals import recorded as recorded
else:
    __getattr__, __dir__, __all__ = lazy(globals())
