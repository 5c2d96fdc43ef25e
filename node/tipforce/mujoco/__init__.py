"""A MuJoCo model with fingertips: contacts become strain, counts, status and estimate, on a CAN bus where wanted."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.mujoco.grasp_env import GraspEnv as GraspEnv
    from tipforce.mujoco.load import Load as Load
    from tipforce.mujoco.mjcf import fingertip_mjcf as fingertip_mjcf
    from tipforce.mujoco.models import grasp_model as grasp_model
    from tipforce.mujoco.models import hand_model as hand_model
    from tipforce.mujoco.serving import TwinNodes as TwinNodes
    from tipforce.mujoco.twin import Fingertips as Fingertips
    from tipforce.mujoco.twin import TwinSample as TwinSample

_MODULES = {
    "Fingertips": "twin",
    "GraspEnv": "grasp_env",
    "TwinSample": "twin",
    "Load": "load",
    "TwinNodes": "serving",
    "fingertip_mjcf": "mjcf",
    "grasp_model": "models",
    "hand_model": "models",
}
__all__ = ["Fingertips", "GraspEnv", "Load", "TwinNodes", "TwinSample", "fingertip_mjcf", "grasp_model", "hand_model"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
