"""Fingers as observations of fixed shape and dtype, for learning: of a live hand, of a simulation, of a recording."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.learning.recorded import Observations as Observations
    from tipforce.learning.recorded import recorded_observations as recorded_observations
    from tipforce.learning.spaces import observation as observation
    from tipforce.learning.spaces import observation_space as observation_space

_MODULES = {
    "observation": "spaces",
    "observation_space": "spaces",
    "Observations": "recorded",
    "recorded_observations": "recorded",
}
__all__ = ["Observations", "observation", "observation_space", "recorded_observations"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
