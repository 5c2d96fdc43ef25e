"""Gauge sources of a node: simulated, with a front end and dynamics, replayed, and Linux Industrial I/O."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.sources.dynamic_load import DynamicForces as DynamicForces
    from tipforce.sources.dynamic_load import DynamicLoad as DynamicLoad
    from tipforce.sources.front_end import Bridge as Bridge
    from tipforce.sources.front_end import FrontEnd as FrontEnd
    from tipforce.sources.front_end import OneOverFNoise as OneOverFNoise
    from tipforce.sources.front_end import Temperature as Temperature
    from tipforce.sources.iio import IioSource as IioSource
    from tipforce.sources.replay import ReplaySource as ReplaySource
    from tipforce.sources.simulated import SimulatedSource as SimulatedSource
else:
    __getattr__, __dir__, __all__ = lazy(globals())
