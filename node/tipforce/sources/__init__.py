"""Gauge sources of a node: simulated, with a front end and dynamics, replayed, and Linux Industrial I/O."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.sources.dynamic_forces import DynamicForces as DynamicForces
    from tipforce.sources.dynamic_load import DynamicLoad as DynamicLoad
    from tipforce.sources.front_end import Bridge as Bridge
    from tipforce.sources.front_end import FrontEnd as FrontEnd
    from tipforce.sources.front_end import OneOverFNoise as OneOverFNoise
    from tipforce.sources.front_end import Temperature as Temperature
    from tipforce.sources.front_end import WhiteNoise as WhiteNoise
    from tipforce.sources.iio import IioSource as IioSource
    from tipforce.sources.replay import ReplaySource as ReplaySource
    from tipforce.sources.simulated import SimulatedSource as SimulatedSource

_MODULES = {
    "SimulatedSource": "simulated",
    "FrontEnd": "front_end",
    "Bridge": "front_end",
    "Temperature": "front_end",
    "WhiteNoise": "front_end",
    "OneOverFNoise": "front_end",
    "DynamicLoad": "dynamic_load",
    "DynamicForces": "dynamic_forces",
    "ReplaySource": "replay",
    "IioSource": "iio",
}
__all__ = [
    "Bridge",
    "DynamicForces",
    "DynamicLoad",
    "FrontEnd",
    "IioSource",
    "OneOverFNoise",
    "ReplaySource",
    "SimulatedSource",
    "Temperature",
    "WhiteNoise",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
