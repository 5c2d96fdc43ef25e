"""Simulate CANopen devices of any manufacturer: from their EDS, with values, behaviour and faults of your own."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.machine.application import DeviceApplication as DeviceApplication
    from tipforce.machine.cia402 import Drive as Drive
    from tipforce.machine.device import SimulatedDevice as SimulatedDevice
    from tipforce.machine.device import shipped_eds as shipped_eds
    from tipforce.machine.running import device_from_file as device_from_file
    from tipforce.machine.running import simulated_device as simulated_device
    from tipforce.machine.running import simulated_devices as simulated_devices
    from tipforce.machine.signals import Follows as Follows
    from tipforce.machine.signals import Ramp as Ramp
    from tipforce.machine.signals import RandomWalk as RandomWalk
    from tipforce.machine.signals import Recorded as Recorded
    from tipforce.machine.signals import Sine as Sine
    from tipforce.machine.signals import recorded as recorded

_MODULES = {
    "simulated_device": "running",
    "simulated_devices": "running",
    "device_from_file": "running",
    "SimulatedDevice": "device",
    "shipped_eds": "device",
    "DeviceApplication": "application",
    "Drive": "cia402",
    "Ramp": "signals",
    "Sine": "signals",
    "RandomWalk": "signals",
    "Recorded": "signals",
    "recorded": "signals",
    "Follows": "signals",
}
__all__ = [
    "DeviceApplication",
    "Drive",
    "Follows",
    "Ramp",
    "RandomWalk",
    "Recorded",
    "SimulatedDevice",
    "Sine",
    "device_from_file",
    "recorded",
    "shipped_eds",
    "simulated_device",
    "simulated_devices",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
