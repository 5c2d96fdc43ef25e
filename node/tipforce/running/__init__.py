"""Run any CANopen device on a bus: the loop, the ports, the parameter store."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.running.loop import Port as Port
    from tipforce.running.loop import now_us as now_us
    from tipforce.running.loop import run as run
    from tipforce.running.ports import PythonCanPort as PythonCanPort
    from tipforce.running.ports import SocketCanPort as SocketCanPort
    from tipforce.running.store import FileStore as FileStore

_MODULES = {
    "run": "loop",
    "now_us": "loop",
    "Port": "loop",
    "PythonCanPort": "ports",
    "SocketCanPort": "ports",
    "FileStore": "store",
}
__all__ = [
    "FileStore",
    "Port",
    "PythonCanPort",
    "SocketCanPort",
    "now_us",
    "run",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
