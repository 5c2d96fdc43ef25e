"""Scenes in TOML: loads, nodes, faults and outputs; each builds only the parts that it names."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.scene.run import Options as Options
    from tipforce.scene.run import Outcome as Outcome
    from tipforce.scene.run import run_scene as run_scene
    from tipforce.scene.scene_parts import Part as Part
    from tipforce.scene.scene_parts import parts as parts
    from tipforce.scene.schema import Scene as Scene
    from tipforce.scene.schema import read_scene as read_scene
    from tipforce.scene.simulated_bus import beam_calibration as beam_calibration

_MODULES = {
    "Scene": "schema",
    "read_scene": "schema",
    "run_scene": "run",
    "Options": "run",
    "Outcome": "run",
    "Part": "scene_parts",
    "parts": "scene_parts",
    "beam_calibration": "simulated_bus",
}
__all__ = [
    "Options",
    "Outcome",
    "Part",
    "Scene",
    "beam_calibration",
    "parts",
    "read_scene",
    "run_scene",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
