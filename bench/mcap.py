"""MCAP of `tipforce decode` beside CSV of the same samples: size and processor time, interleaved in one run.

python -m bench.mcap                                  200 000 frames of five fingers, three times each
python -m bench.mcap --picture docs/figures/foxglove-scene.svg
                                                      draws a scene update of a file, as its reader gives it
"""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from bench.decode import hand_traffic, write_log
from bench.measure import arguments, cpu_s, in_turns, new_svg_figure
from mcap.reader import make_reader

from canopen_device.core.codes import TPDO_BASES
from tipforce.output_file import save_figure
from tipforce_tools.cli.main import main as tipforce

FRAMES, REPEATS = 200_000, 3
FORMATS = {"ROS 2 messages, drawing and frames": ".mcap", "CSV": ".csv"}


def as_decoded(log: Path, output: Path) -> None:
    """Write what `tipforce decode` writes, by one process."""
    assert tipforce(["decode", "-q", str(log), "-o", str(output), "--jobs", "1"]) == 0


def compare(log: Path, samples: int) -> dict[str, tuple[float, float]]:
    """Return of each format bytes and processor microseconds for each sample; the formats take turns."""

    def way(suffix: str) -> tuple[float, float]:
        output = log.with_suffix(suffix)
        us = 1e6 * cpu_s(partial(as_decoded, log, output)) / samples
        size = output.stat().st_size / samples
        output.unlink()
        return size, us

    figures = in_turns({name: partial(way, suffix) for name, suffix in FORMATS.items()}, REPEATS)
    return {name: (runs[0][0], min(us for _, us in runs)) for name, runs in figures.items()}


def draw(recording: Path, output: Path) -> None:
    """Draw the scene update with the largest force in a file, by the fields of foxglove.SceneUpdate alone."""
    with recording.open("rb") as stream:
        messages = make_reader(stream).iter_messages(topics=["/tipforce/scene"])
        scenes = [json.loads(message.data)["entities"] for _, _, message in messages]
    scene = max(scenes, key=lambda entities: sum(a["shaft_length"] for entity in entities for a in entity["arrows"]))
    figure, axes = new_svg_figure(9, 2.6)
    for entity in scene:
        for line in entity["lines"]:
            at, points = line["pose"]["position"], line["points"]
            axes.plot([at["x"] + p["x"] for p in points], [at["y"] + p["y"] for p in points], color=_rgb(line), lw=2)
        for arrow in entity["arrows"]:
            at, turn, length = (
                arrow["pose"]["position"],
                arrow["pose"]["orientation"],
                arrow["shaft_length"] + arrow["head_length"],
            )
            c, s = turn["w"] ** 2 - turn["z"] ** 2, 2.0 * turn["w"] * turn["z"]
            axes.annotate(
                "", (at["x"] + length * c, at["y"] + length * s), (at["x"], at["y"]),
                arrowprops={"color": _rgb(arrow), "width": 1.5, "headwidth": 7, "headlength": 8},
            )  # fmt: skip
        for text in entity["texts"]:
            at = text["pose"]["position"]
            axes.text(at["x"], at["y"], text["text"], ha="center", va="top", fontsize=9, color=_rgb(text))
    axes.set_aspect("equal")
    axes.axis("off")
    axes.margins(0.05, 0.25)
    save_figure(figure, output)


def _rgb(thing: dict[str, Any]) -> tuple[float, float, float]:
    color = thing["color"]
    return color["r"], color["g"], color["b"]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--picture", type=Path, metavar="FILE.svg")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "run.log")
        if args.picture:
            assert tipforce(["run", "grasp", "-q", "-o", str(log)]) == 0
            as_decoded(log, log.with_suffix(".mcap"))
            draw(log.with_suffix(".mcap"), args.picture)
            return
        frames = hand_traffic(FRAMES, 5, variable=True, seed=1)
        write_log(log, frames)
        samples = int((frames["can_id"] & 0x780 == TPDO_BASES[1]).sum())
        print(f"{samples} samples of five fingers, log: {log.stat().st_size / samples:.0f} bytes a sample")
        for name, (size, us) in compare(log, samples).items():
            print(f"{name:36} {size:6.0f} bytes {us:6.1f} us a sample")


if __name__ == "__main__":
    main()
