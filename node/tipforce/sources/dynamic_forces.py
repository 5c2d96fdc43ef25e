"""Pass a load history through the dynamics of the structure: the ``forces`` of a simulated source."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from .dynamic_load import DynamicLoad
    from .simulated import Forces


class DynamicForces:
    """The elastic force under ``applied(now_us)``, stepped by ``step_us`` from the time of the first call on.

    ``dynamics`` is built for steps of ``step_us``, which is the sample period of the source (6114h) or an integer
    fraction of it; within a step the load is linear. It starts in equilibrium under the first load. Steps are also
    computed for conversions that are not read, so the force does not depend on how often the node reads.
    """

    def __init__(self, dynamics: "DynamicLoad", applied: "Callable[[int], Forces]", step_us: int) -> None:
        if step_us < 1:
            raise ValueError("step_us: %r, allowed is 1 or more" % step_us)
        self._dynamics = dynamics
        self._applied = applied
        self._step_us = step_us
        self._now_us = -1
        self._load: "Forces" = (0.0, 0.0, 0.0)
        self._force: "Forces" = (0.0, 0.0, 0.0)

    def __call__(self, now_us: int) -> "Forces":
        """Return F1, F2, F3 in newtons at the last step that is not after ``now_us``."""
        if self._now_us < 0:
            self._now_us = now_us
            self._load = self._force = self._applied(now_us)
            self._dynamics.settle(self._load)
        while self._now_us + self._step_us <= now_us:
            self._now_us += self._step_us
            load = self._applied(self._now_us)
            self._force = self._dynamics.step(self._load, load)
            self._load = load
        return self._force
