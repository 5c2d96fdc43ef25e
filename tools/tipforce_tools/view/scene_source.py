"""A scene as the source of a page: run in simulated time, then shown like the log that it would write."""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from tipforce.errors import InputError
from tipforce.scene.run import Options, run_scene
from tipforce.scene.schema import Outputs, read_scene
from tipforce_tools.view.fingers import Finger, with_layout
from tipforce_tools.view.log_source import LogSource

if TYPE_CHECKING:
    from tipforce.scene.schema import Scene


def is_scene(path: Path) -> bool:
    """Return whether a TOML file is a scene; the reader of hand files reports an unreadable file."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return False
    return "nodes" in content and "finger" not in content


def scene_source(
    path: Path, make_finger: Callable[[int], Finger | None], gauges: int, start_s: float, end_s: float | None
) -> LogSource:
    """Run the scene without its output files, expectations and bus. Raises InputError."""
    scene = replace(read_scene(path), outputs=Outputs(), expect=(), bus=None)
    layouts = _layouts(scene)

    def make(node_id: int) -> Finger | None:
        finger = make_finger(node_id)
        return finger and with_layout(finger, "" if finger.layout else layouts.get(node_id, ""), None)

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "scene.log"
        run_scene(scene, path.parent, Options(log=str(log)))
        try:
            source = LogSource(log, make, gauges, (), start_s, end_s)
        except InputError as error:
            raise InputError(str(error).replace(str(log), str(path))) from None
    source.title, source.no_tare = path.name, "a scene can't be tared"
    return source


def _layouts(scene: Scene) -> dict[int, str]:
    """Return the named layouts by node-id."""
    return {node_id: nodes.layout for nodes in scene.nodes if isinstance(nodes.layout, str) for node_id in nodes.ids}
