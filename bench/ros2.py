"""`tipforce ros2` at full rate: wrenches that rosless receives in another process, beside `decode` of the same frames.

    python -m bench.ros2                          five fingers at 500 Hz for 60 s
    python -m bench.ros2 --figures docs/figures    draws what the reader receives of the shipped scene of a grasp, and
                                                  a scene update of its MCAP file

In a network namespace of its own. Fingers, SYNC, host (a Hand and the bridge of the command) and reader are processes
of their own. Exit code 1 if less than 99.9 % of the wrenches that decode gives arrive, or one differs."""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from bench.decode import write_log
from bench.hand import CALIBRATION, brought_up
from bench.loopback import LoopbackLink
from bench.measure import Meter, arguments
from matplotlib.figure import Figure
from mcap.reader import make_reader

from canopen_device.core.codes import SYNC_COB_ID
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.file import HandPlan
from tipforce.output_file import save_figure
from tipforce_tools.cli.main import main as tipforce

FINGERS, SYNC_HZ, SECONDS, RADIUS_M = 5, 500.0, 60.0, 0.015
LEAST_SHARE, TOLERANCE = 0.999, 1e-9
_NAMESPACE = 'ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec "$@"'
_INSIDE = "TIPFORCE_BENCH_NAMESPACE"
_OVERFLOW = 240
_ROW = np.dtype([("t_ns", "i8"), ("x", "f8"), ("y", "f8"), ("torque", "f8")])

Rows = npt.NDArray[np.void]


class RecordingLink(LoopbackLink):
    """Keeps the frames that the hand received."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.frames: list[FrameArray] = []

    def receive(self, timeout_s: float) -> FrameArray:
        frames = super().receive(timeout_s)
        if len(frames):
            self.frames.append(frames.copy())
        return frames


def publish(folder: Path) -> tuple[FrameArray, dict[str, Any]]:
    """Run hand, bridge and reader; return the frames, and what was published."""
    from tipforce.watching.feeds import Finger, HandFeed
    from tipforce_robots.ros2.bridge import Bridge
    from tipforce_robots.ros2.cdr import WRENCH
    from tipforce_robots.ros2.dds import RosDomain

    names = {n: f"f{n}" for n in range(1, FINGERS + 1)}
    link, plan = RecordingLink(FINGERS), HandPlan(sync_hz=SYNC_HZ, wait_ms=200)
    reader = _reader(folder, "f", subprocess.PIPE)
    try:
        with brought_up(folder, names, plan, link=link) as hand:
            feed = HandFeed(hand, [Finger(n, name, CALIBRATION) for n, name in names.items()])
            bridge = Bridge(feed, RosDomain(0), "/tipforce", False)
            bridge.step()  # makes the topics
            assert reader.stdout is not None
            reader.stdout.readline()  # it has subscribed
            while not all(tip.publishers[WRENCH].readers for tip in bridge.tips.values()):
                time.sleep(0.01)
            link.frames.clear()
            hand.start()
            while not bridge.rows:  # the process that sends the SYNC starts
                bridge.step()
            meter = Meter()
            while meter.elapsed_s < SECONDS:
                bridge.step()
            cpu_share = round(meter.share, 3)
            hand.stop()
            for _ in range(3):
                bridge.step()
            counts = {"rows": bridge.rows, "wrenches": bridge.wrenches, "cpu_share": cpu_share}
            counts |= {"missing": int(hand.statistics().tally.missing.sum()), "overrun": feed.overrun}
            time.sleep(1.0)
        reader.communicate(b"\n", timeout=60)
    finally:
        reader.kill()
        link.close()
    return np.concatenate(link.frames), counts


def _reader(folder: Path, prefix: str, stdout: int) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", "bench.ros2", "--read", str(folder), "--prefix", prefix]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=stdout)


def read(folder: Path, prefix: str) -> None:
    """The reader's process: keep every wrench until stdin says end."""
    import rosless

    node = rosless.Node(0)
    while not {f"/tipforce/{prefix}{n}/wrench" for n in range(1, FINGERS + 1)} <= {
        topic.name for topic in node.graph().topics
    }:
        time.sleep(0.05)
    received: dict[int, list[tuple[int, float, float, float]]] = {n: [] for n in range(1, FINGERS + 1)}
    ended = threading.Event()

    def take(n: int, subscription: Any) -> None:
        rows = received[n]
        while (message := subscription.read(timeout=0.5)) is not None or not ended.is_set():
            if message is not None:
                stamp, wrench = message.header.stamp, message.wrench
                t_ns = stamp.sec * 10**9 + stamp.nanosec
                rows.append((t_ns, wrench.force.x, wrench.force.y, wrench.torque.z))

    threads = []
    for n in received:
        subscription = node.subscribe(f"/tipforce/{prefix}{n}/wrench", depth=10_000)
        threads.append(threading.Thread(target=take, args=(n, subscription)))
        threads[-1].start()
    topics = {topic.name: topic.type_name for topic in node.graph().topics}
    print("subscribed", flush=True)
    sys.stdin.readline()
    ended.set()
    for thread in threads:
        thread.join()
    for n, rows in received.items():
        np.save(folder / f"read{n}.npy", np.array(rows, dtype=_ROW))
    (folder / "topics.json").write_text(json.dumps(topics))


def decoded(frames: FrameArray, folder: Path) -> dict[int, Rows]:
    """Return by finger the wrenches that `tipforce decode` gives for the frames, stamped with their SYNC."""
    of_sync = frames["can_id"] == SYNC_COB_ID
    syncs, numbers = frames["t_ns"][of_sync], frames["data"][of_sync, 0].astype(np.int64)  # 1 to _OVERFLOW
    log, output = folder / "run.log", folder / "run.csv"
    write_log(log, frames)
    assert tipforce(["decode", "-q", str(log), "-o", str(output), "--signals", "P,phi,theta"]) == 0
    table = np.genfromtxt(output, delimiter=",", names=True, dtype=None, encoding="utf-8")
    by_finger = {}
    for n in range(1, FINGERS + 1):
        rows = table[table["node"] == n]
        t_ns = np.round(rows["t_s"] * 1e9).astype(np.int64)
        last = np.searchsorted(syncs, t_ns + 1500) - 1  # the log has microseconds
        sent = (rows["counter"].astype(np.int64) - 1) % _OVERFLOW + 1  # each sample repeats the number of its SYNC
        number = last - (numbers[last] - sent) % _OVERFLOW
        assert (numbers[number] == sent).all()
        P, phi, theta = rows["P_N"], np.radians(rows["phi_deg"]), np.radians(rows["theta_deg"])
        known = np.isfinite(P + phi + theta)
        wrenches = np.zeros(int(known.sum()), dtype=_ROW)
        wrenches["t_ns"] = syncs[number[known]]
        wrenches["x"], wrenches["y"] = (P * np.cos(phi))[known], (P * np.sin(phi))[known]
        wrenches["torque"] = (RADIUS_M * P * np.sin(phi - theta))[known]
        by_finger[n] = wrenches
    return by_finger


def compare(expected: dict[int, Rows], folder: Path) -> dict[str, Any]:
    """Return counts, the share that arrived, and the largest difference."""
    total = arrived = extra = 0
    largest = 0.0
    for n, wrenches in expected.items():
        read_rows = np.load(folder / f"read{n}.npy")
        _, ours, theirs = np.intersect1d(wrenches["t_ns"], read_rows["t_ns"], return_indices=True)
        total, arrived = total + len(wrenches), arrived + len(ours)
        extra += len(read_rows) - len(theirs)
        for name in ("x", "y", "torque"):
            difference = np.abs(wrenches[name][ours] - read_rows[name][theirs])
            largest = max(largest, float(difference.max(initial=0.0)))
    share = arrived / total if total else math.nan
    return {"decoded": total, "received": arrived, "share": share, "extra": extra, "largest_difference": largest}


def draw(figures: Path) -> None:
    """Publish the log of the scene `grasp` with `tipforce ros2`, and draw what the reader receives of it; and draw the
    scene update with the largest force in its MCAP file, by the fields of foxglove.SceneUpdate alone."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "grasp.log"
        assert tipforce(["run", "grasp", "-q", "-o", str(log)]) == 0
        reader = _reader(folder, "finger_", subprocess.DEVNULL)
        # Slowly: the subscriptions are there before the hand closes.
        assert tipforce(["ros2", str(log), "--speed", "0.04", "-q"]) == 0
        reader.communicate(b"\n", timeout=60)
        read_rows = {n: np.load(folder / f"read{n}.npy") for n in range(1, FINGERS + 1)}
        assert tipforce(["decode", "-q", str(log), "-o", str(log.with_suffix(".mcap"))]) == 0
        with log.with_suffix(".mcap").open("rb") as stream:
            messages = make_reader(stream).iter_messages(topics=["/tipforce/scene"])
            scenes = [json.loads(message.data)["entities"] for _, _, message in messages]
    mpl.rcParams["svg.hashsalt"] = "tipforce"  # the same bytes each time
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    axes = figure.subplots()
    for n, rows in read_rows.items():
        axes.plot((rows["t_ns"] % 10**11) / 1e9, np.hypot(rows["x"], rows["y"]), label=f"/tipforce/finger_{n}/wrench")
    axes.set(xlabel="stamp, s", ylabel="force, N")
    axes.set_xlim(left=min(float(rows["t_ns"][0] % 10**11) / 1e9 for rows in read_rows.values()) - 0.1)
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, figures / "ros2-received.svg")
    scene = max(scenes, key=lambda entities: sum(a["shaft_length"] for entity in entities for a in entity["arrows"]))
    figure = Figure(figsize=(9, 2.6), layout="constrained")
    axes = figure.subplots()
    for entity in scene:
        for line in entity["lines"]:
            at, points = line["pose"]["position"], line["points"]
            axes.plot([at["x"] + p["x"] for p in points], [at["y"] + p["y"] for p in points], color=_rgb(line), lw=2)
        for arrow in entity["arrows"]:
            at, turn = arrow["pose"]["position"], arrow["pose"]["orientation"]
            length = arrow["shaft_length"] + arrow["head_length"]
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
    save_figure(figure, figures / "foxglove-scene.svg")


def _rgb(thing: dict[str, Any]) -> tuple[float, float, float]:
    color = thing["color"]
    return color["r"], color["g"], color["b"]


def main() -> int:
    parser = arguments(__doc__)
    parser.add_argument("--read", type=Path, metavar="FOLDER", help=argparse.SUPPRESS)
    parser.add_argument("--prefix", default="f", help=argparse.SUPPRESS)
    parser.add_argument("--figures", type=Path, metavar="DIR")
    args = parser.parse_args()
    if args.read:
        read(args.read, args.prefix)
        return 0
    if _INSIDE not in os.environ:
        again = ["unshare", "-rn", "sh", "-c", _NAMESPACE, "sh", sys.executable, "-m", "bench.ros2"]
        done = subprocess.run([*again, *sys.argv[1:]], env={**os.environ, _INSIDE: "1"}, check=False)
        return done.returncode
    if args.figures:
        draw(args.figures)
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames, counts = publish(folder)
        result = {"seconds": SECONDS, "sync_hz": SYNC_HZ, **counts, **compare(decoded(frames, folder), folder)}
        result["topics"] = json.loads((folder / "topics.json").read_text())
    print(json.dumps(result, indent=1))
    return 0 if result["share"] >= LEAST_SHARE and result["largest_difference"] <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
