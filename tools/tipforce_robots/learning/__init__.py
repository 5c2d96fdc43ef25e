"""Fingers as observations of fixed shape and dtype, for learning: of a live hand, of a simulation, of a recording."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce_robots.learning.observations import Observations as Observations
    from tipforce_robots.learning.observations import observation as observation
    from tipforce_robots.learning.observations import observation_space as observation_space
    from tipforce_robots.learning.observations import recorded_observations as recorded_observations
else:
    __getattr__, __dir__, __all__ = lazy(globals())
