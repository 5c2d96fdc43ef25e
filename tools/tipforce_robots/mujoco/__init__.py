"""A MuJoCo model with fingertips: contacts become strain, counts, status and estimate, on a CAN bus where wanted."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce_robots.mujoco.grasp_env import GraspEnv as GraspEnv
    from tipforce_robots.mujoco.models import fingertip_mjcf as fingertip_mjcf
    from tipforce_robots.mujoco.models import grasp_model as grasp_model
    from tipforce_robots.mujoco.models import hand_model as hand_model
    from tipforce_robots.mujoco.serving import TwinNodes as TwinNodes
    from tipforce_robots.mujoco.twin import Fingertips as Fingertips
    from tipforce_robots.mujoco.twin import Load as Load
    from tipforce_robots.mujoco.twin import TwinSample as TwinSample
else:
    __getattr__, __dir__, __all__ = lazy(globals())
