"""Run any CANopen device on a bus: the loop, the ports, the parameter store."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.running.loop import Port as Port
    from canopen_device.running.loop import now_us as now_us
    from canopen_device.running.loop import run as run
    from canopen_device.running.open_bus import PythonCanPort as PythonCanPort
    from canopen_device.running.ports import SocketCanPort as SocketCanPort
    from canopen_device.running.store import FileStore as FileStore
else:
    __getattr__, __dir__, __all__ = lazy(globals())
