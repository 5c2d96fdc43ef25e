"""A MuJoCo model with fingertips: contacts become strain, counts, status and estimate, on a CAN bus where wanted."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.mujoco.load import Load as Load
    from tipforce.mujoco.mjcf import fingertip_mjcf as fingertip_mjcf
    from tipforce.mujoco.twin import Fingertips as Fingertips
    from tipforce.mujoco.twin import TwinSample as TwinSample

_MODULES = {
    "Fingertips": "twin",
    "TwinSample": "twin",
    "Load": "load",
    "fingertip_mjcf": "mjcf",
}
__all__ = ["Fingertips", "Load", "TwinSample", "fingertip_mjcf"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
