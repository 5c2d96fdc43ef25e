"""Scenes in TOML: loads, nodes, faults and outputs; only the named parts are built."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.scene.delivered import beam_calibration as beam_calibration
    from tipforce.scene.reader import read_scene as read_scene
    from tipforce.scene.registry import Part as Part
    from tipforce.scene.registry import parts as parts
    from tipforce.scene.run import Outcome as Outcome
    from tipforce.scene.run import run_scene as run_scene
    from tipforce.scene.schema import Scene as Scene
else:
    __getattr__, __dir__, __all__ = lazy(globals())
