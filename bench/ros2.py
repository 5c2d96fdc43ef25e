"""`tipforce ros2` at full rate: wrenches that rosless receives in another process, beside `decode` of the same frames.

    python -m bench.ros2                          five fingers at 500 Hz for 60 s
    python -m bench.ros2 --seconds 5
    python -m bench.ros2 --picture docs/figures/ros2-received.svg
                                                  draws what the reader receives of the shipped scene of a grasp

All runs in a network namespace with only a loopback interface. Fingers, SYNC, host (a Hand and the bridge of the
command) and reader are processes of their own; hand_bus.py is the bus. A row waits 200 ms for a late finger, so that a
busy machine does not count. Exit code 1 if less than 99.9 % of the wrenches that decode gives arrive, or one differs.
"""

from __future__ import annotations

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

import numpy as np
import numpy.typing as npt
from bench.hand_bus import LoopbackLink
from bench.soak_fingers import calibration

from tipforce.device.codes import SYNC_COB_ID
from tipforce.host.configuration.calibration_file import write_calibration
from tipforce.host.frames.frame_array import FrameArray
from tipforce.host.hand.file import FingerPlan, HandFile, HandPlan
from tipforce.host.hand.hand import Hand
from tipforce_tools.cli.main import main as tipforce

ROOT = Path(__file__).parents[1]
FINGERS, SYNC_HZ, RADIUS_M = 5, 500.0, 0.015
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
        """See Link."""
        frames = super().receive(timeout_s)
        if len(frames):
            self.frames.append(frames.copy())
        return frames


def publish(seconds: float, folder: Path) -> tuple[FrameArray, dict[str, Any]]:
    """Run hand, bridge and reader; return the frames, and what was published."""
    from tipforce_tools.ros2.bridge import Bridge
    from tipforce_tools.ros2.dds import RosDomain
    from tipforce_tools.ros2.feeds import HandFeed
    from tipforce_tools.view.fingers import Finger

    write_calibration(folder / "cal.toml", calibration())
    plans = tuple(FingerPlan(node_id=n, name=f"f{n}", calibration="cal.toml") for n in range(1, FINGERS + 1))
    file = HandFile(finger=plans, hand=HandPlan(sync_hz=SYNC_HZ, wait_ms=200), folder=str(folder))
    link = RecordingLink(FINGERS)
    reader = subprocess.Popen(
        [sys.executable, "-m", "bench.ros2", "--read", str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        with Hand(file, link) as hand:
            failed = [str(report) for report in hand.bring_up() if not report.ok]
            if failed:
                raise RuntimeError("; ".join(failed))
            feed = HandFeed(hand, [Finger(n, f"f{n}", calibration()) for n in range(1, FINGERS + 1)])
            bridge = Bridge(feed, RosDomain(0), "/tipforce", 3, False)
            bridge.step()  # makes the topics
            assert reader.stdout is not None
            reader.stdout.readline()  # it has subscribed
            while not all(tip._wrench.readers for tip in bridge.tips.values()):
                time.sleep(0.01)
            link.frames.clear()
            hand.start()
            while not bridge.rows:  # the process that sends the SYNC starts
                bridge.step()
            cpu_s, end_s = time.process_time(), time.monotonic() + seconds
            while time.monotonic() < end_s:
                bridge.step()
            cpu_s = time.process_time() - cpu_s
            hand.stop()
            for _ in range(3):
                bridge.step()
            told = {"rows": bridge.rows, "wrenches": bridge.wrenches, "cpu_share": round(cpu_s / seconds, 3)}
            told |= {"missing": int(hand.statistics().tally.missing.sum()), "overrun": feed.overrun}
            time.sleep(1.0)
        reader.communicate(b"\n", timeout=60)
    finally:
        reader.kill()
        link.close()
    return np.concatenate(link.frames), told


def read(folder: Path, prefix: str) -> None:
    """The reader's process: keep every wrench until stdin says end."""
    import rosless

    node = rosless.Node(0)
    while not {f"/tipforce/{prefix}{n}/wrench" for n in range(1, FINGERS + 1)} <= {
        topic.name for topic in node.graph().topics
    }:
        time.sleep(0.05)
    found: dict[int, list[tuple[int, float, float, float]]] = {n: [] for n in range(1, FINGERS + 1)}
    ended = threading.Event()

    def take(n: int, subscription: Any) -> None:
        rows = found[n]
        while (message := subscription.read(timeout=0.5)) is not None or not ended.is_set():
            if message is not None:
                stamp, wrench = message.header.stamp, message.wrench
                row = stamp.sec * 10**9 + stamp.nanosec, wrench.force.x, wrench.force.y, wrench.torque.z
                rows.append(row)

    threads = []
    for n in found:
        subscription = node.subscribe(f"/tipforce/{prefix}{n}/wrench", depth=10_000)
        threads.append(threading.Thread(target=take, args=(n, subscription)))
        threads[-1].start()
    topics = {topic.name: topic.type_name for topic in node.graph().topics}
    print("subscribed", flush=True)
    sys.stdin.readline()
    ended.set()
    for thread in threads:
        thread.join()
    for n, rows in found.items():
        np.save(folder / f"read{n}.npy", np.array(rows, dtype=_ROW))
    (folder / "topics.json").write_text(json.dumps(topics))


def decoded(frames: FrameArray, folder: Path) -> dict[int, Rows]:
    """Return by finger the wrenches that `tipforce decode` gives for the frames, stamped with their SYNC."""
    of_sync = frames["can_id"] == SYNC_COB_ID
    syncs, numbers = frames["t_ns"][of_sync], frames["data"][of_sync, 0].astype(np.int64)  # 1 to _OVERFLOW
    log, output = folder / "run.log", folder / "run.csv"
    with log.open("w") as file:
        for one in frames:
            t_ns, data = int(one["t_ns"]), one["data"][: one["length"]].tobytes().hex().upper()
            file.write(f"({t_ns // 10**9}.{t_ns % 10**9:09d}) can0 {one['can_id']:03X}#{data}\n")
    assert tipforce(["decode", "-q", str(log), "-o", str(output), "--signals", "P,phi,theta"]) == 0
    table = np.genfromtxt(output, delimiter=",", names=True, dtype=None, encoding="utf-8")
    found = {}
    for n in range(1, FINGERS + 1):
        rows = table[table["node"] == n]
        t_ns = np.round(rows["t_s"] * 1e9).astype(np.int64)
        last = np.searchsorted(syncs, t_ns + 500) - 1  # a double has 240 ns at present times
        sent = (rows["counter"].astype(np.int64) - 1) % _OVERFLOW + 1  # each sample repeats the number of its SYNC
        number = last - (numbers[last] - sent) % _OVERFLOW
        assert (numbers[number] == sent).all()
        P, phi, theta = rows["P_N"], np.radians(rows["phi_deg"]), np.radians(rows["theta_deg"])
        known = np.isfinite(P + phi + theta)
        wrenches = np.zeros(int(known.sum()), dtype=_ROW)
        wrenches["t_ns"] = syncs[number[known]]
        wrenches["x"], wrenches["y"] = (P * np.cos(phi))[known], (P * np.sin(phi))[known]
        wrenches["torque"] = (RADIUS_M * P * np.sin(phi - theta))[known]
        found[n] = wrenches
    return found


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


def run(seconds: float) -> dict[str, Any]:
    """Measure; to be called inside the namespace."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames, told = publish(seconds, folder)
        found = compare(decoded(frames, folder), folder)
        topics = json.loads((folder / "topics.json").read_text())
    return {"seconds": seconds, "sync_hz": SYNC_HZ, **told, **found, "topics": topics}


def draw(output: Path) -> None:
    """Publish the log of the scene `grasp` with `tipforce ros2`, and draw what the reader receives of it."""
    import matplotlib as mpl

    mpl.use("svg")
    import matplotlib.pyplot as plt

    mpl.rcParams["svg.hashsalt"] = "tipforce"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "grasp.log"
        assert tipforce(["run", "grasp", "-q", "-o", str(log)]) == 0
        reader = subprocess.Popen(
            [sys.executable, "-m", "bench.ros2", "--read", name, "--prefix", "finger_"],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        # Slowly: the subscriptions are there before the hand closes.
        assert tipforce(["ros2", str(log), "--speed", "0.04", "-q"]) == 0
        reader.communicate(b"\n", timeout=60)
        read_rows = {n: np.load(folder / f"read{n}.npy") for n in range(1, FINGERS + 1)}
    figure, axes = plt.subplots(figsize=(9, 3.2), layout="constrained")
    for n, rows in read_rows.items():
        axes.plot((rows["t_ns"] % 10**11) / 1e9, np.hypot(rows["x"], rows["y"]), label=f"/tipforce/finger_{n}/wrench")
    axes.set(xlabel="stamp, s", ylabel="force, N")
    axes.set_xlim(left=min(float(rows["t_ns"][0] % 10**11) / 1e9 for rows in read_rows.values()) - 0.1)
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, metadata={"Date": None})


def main() -> int:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--read", type=Path, metavar="FOLDER", help=argparse.SUPPRESS)
    parser.add_argument("--prefix", default="f", help=argparse.SUPPRESS)
    parser.add_argument("--picture", type=Path, metavar="FILE.svg")
    args = parser.parse_args()
    if args.read:
        read(args.read, args.prefix)
        return 0
    if _INSIDE not in os.environ:
        again = ["unshare", "-rn", "sh", "-c", _NAMESPACE, "sh", sys.executable, "-m", "bench.ros2"]
        done = subprocess.run([*again, *sys.argv[1:]], env={**os.environ, _INSIDE: "1"}, check=False)
        return done.returncode
    if args.picture:
        draw(args.picture)
        return 0
    found = run(args.seconds)
    print(json.dumps(found, indent=1))
    return 0 if found["share"] >= LEAST_SHARE and found["largest_difference"] <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
