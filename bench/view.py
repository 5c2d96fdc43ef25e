"""The web page under load: pictures a second at 15 fingers, and whether the receive loop loses a sample by it.

    python -m bench.view                  the measurement; about a minute
    python -m bench.view --screenshots    docs/figures/view-*.png, from the simulated hand

A process of its own sends SYNC, contact and gauge PDOs of all fingers through a loopback socket into the live receive
path (bench/live_loopback.py); the page runs in headless Chromium. "lost rows" are SYNCs that were sent and did not
become a whole row. Figures are as found on this machine; nothing is asserted.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import multiprocessing
import os
import platform
import shutil
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.live_loopback import ROOT, bound_receiver
from playwright.sync_api import Browser, Page, sync_playwright
from websockets.sync.client import connect

from tipforce.host.live.receive import SocketReceiver
from tipforce.scene import beam_calibration
from tipforce_tools.view.fingers import Finger, with_layout
from tipforce_tools.view.guard import Guard
from tipforce_tools.view.server import ViewServer
from tipforce_tools.view.sources import ListenSource

FINGERS, SYNC_HZ = 15, 400
FIGURES = ROOT / "docs" / "figures"
_FRAME = struct.Struct("=IB3x8s")
_SETTLE_S = 3.0
_STATUS = 3


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement (default %(default)s)")
    parser.add_argument("--screenshots", action="store_true", help="make the pictures of docs/view.md")
    args = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise SystemExit("Chromium is not there: tools/bootstrap.sh test installs it")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        if args.screenshots:
            screenshots(browser, FIGURES)
        else:
            measure(browser, args.seconds)
        browser.close()


def measure(browser: Browser, seconds: float) -> None:
    """Three runs: nobody looks, one browser looks, and beside it two that do not read what they asked for."""
    print(f"{platform.machine()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f} at the start")
    print(f"{FINGERS} fingers, {SYNC_HZ} Hz, {(2 * FINGERS + 1) * SYNC_HZ} frames/s, {seconds:g} s each")
    head = (
        "browsers",
        "pictures/s",
        "messages/s",
        "longest drawing ms",
        "frames dropped",
        "lost rows",
        "missing",
        "CPU share",
    )
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head))
    for name, looking, idle in (("none", False, 0), ("one", True, 0), ("one, and two that do not read", True, 2)):
        print(f"| {name} | " + " | ".join(one_run(browser, seconds, looking, idle)) + " |", flush=True)


def one_run(browser: Browser, seconds: float, looking: bool, idle: int) -> list[str]:
    """The cells of one line."""
    calibration = beam_calibration(pull=False)

    def finger(node_id: int) -> Finger:
        return with_layout(Finger(node_id, f"finger {node_id}", calibration), "I", None)

    one = bound_receiver()
    source = ListenSource(SocketReceiver(one, "loopback"), "bench", finger)
    server = ViewServer(source, Guard(), ("127.0.0.1",))
    server.start()
    page: Page | None = None
    with sending(one, seconds + 2 * _SETTLE_S + 4.0), contextlib.ExitStack() as stack:
        time.sleep(_SETTLE_S)
        for _ in range(idle):
            stack.enter_context(silent_reader(server.guard.port))
        if looking:
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.goto(server.url)
            page.wait_for_function("() => window.tipforce.drawn > 10")
            page.evaluate("window.tipforce.longest = 0")
        before = counts(page)
        cpu_s, begun_s = time.process_time(), time.monotonic()
        missing = sum(source.model.counters.missing)
        time.sleep(seconds) if page is None else page.wait_for_timeout(1000 * seconds)
        elapsed_s, after = time.monotonic() - begun_s, counts(page)
        cpu_s = time.process_time() - cpu_s
        missing = sum(source.model.counters.missing) - missing
        if page is not None:
            page.close()
    time.sleep(0.5)  # what has come is taken in
    lost, whole = sent_rows(source) - source.model.counters.rows, source.model.counters.rows
    server.close()
    dropped = source.model.counters.dropped
    source.close()
    rates = [f"{(b - a) / elapsed_s:.1f}" if looking else "" for a, b in zip(before[:2], after[:2], strict=True)]
    longest = f"{after[2]:.0f}" if looking else ""
    return [*rates, longest, str(dropped), f"{lost} of {whole}", str(missing), f"{cpu_s / elapsed_s:.2f}"]


def counts(page: Page | None) -> list[float]:
    """Pictures drawn, messages received, longest drawing in ms."""
    if page is None:
        return [0.0, 0.0, 0.0]
    found: list[float] = page.evaluate("[window.tipforce.drawn, window.tipforce.messages, window.tipforce.longest]")
    return found


def sent_rows(source: ListenSource) -> int:
    """How many whole rows came: the frames that were received, by the frames of a row."""
    return source.received // (2 * FINGERS + 1)


@contextlib.contextmanager
def silent_reader(port: int) -> Iterator[None]:
    """A page that asks for the stream and then reads nothing."""
    with connect(f"ws://127.0.0.1:{port}/live", max_queue=1, ping_interval=None) as page:
        page.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        page.send('{"do": "stream", "bin": 2}')
        yield


def send(address: tuple[str, int], seconds: float) -> None:
    """SYNC and all answers, SYNC_HZ times a second; what a late tick missed follows in the next."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.connect(address)
        begun_s, number = time.monotonic(), 0
        while number < seconds * SYNC_HZ:
            due = int((time.monotonic() - begun_s) * SYNC_HZ)
            for k in range(number, due):
                for frame in row(k):
                    one.send(frame)
            number = max(due, number)
            time.sleep(0.001)


def row(k: int) -> list[bytes]:
    """The frames of SYNC number k."""
    frames = [_FRAME.pack(0x80, 0, b"")]
    for node_id in range(1, FINGERS + 1):
        angle = 0.9 * k / SYNC_HZ + node_id
        theta = round(9000 + 4000 * math.sin(angle))
        P = round(2500 + 1500 * math.sin(1.7 * angle))
        strain = [round(2000 * math.sin(angle + n)) for n in range(3)]
        counter = k % 256
        contact = struct.pack("<hhhBB", P, theta - 18000, theta, _STATUS, counter)
        gauges = struct.pack("<hhhBB", *strain, _STATUS, counter)
        frames += [_FRAME.pack(0x280 + node_id, 8, contact), _FRAME.pack(0x180 + node_id, 8, gauges)]
    return frames


@contextlib.contextmanager
def sending(receiver: socket.socket, seconds: float) -> Iterator[None]:
    """A process that sends while the block runs."""
    process = multiprocessing.get_context("spawn").Process(
        target=send, args=(receiver.getsockname(), seconds), daemon=True
    )
    process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join()


def screenshots(browser: Browser, folder: Path) -> None:
    """The simulated hand, light on a desktop and dark on a phone, while a finger has a fault; and a recording."""
    from tipforce.shipped_files import shipped_folder
    from tipforce_tools.view.command import hand_source
    from tipforce_tools.view.demo import simulated_hand
    from tipforce_tools.view.scene_source import scene_source

    with simulated_hand() as (hand, _):
        source: Any = hand_source(argparse.Namespace(quiet=True), hand, "simulated hand")
        server = ViewServer(source, Guard(allow_writes=True), ("127.0.0.1",))
        server.start()
        # The fault of the middle finger begins 8 s after the nodes were switched on, and lasts for 3 s.
        desktop = browser.new_page(viewport={"width": 1280, "height": 900}, color_scheme="light")
        desktop.goto(server.url)
        desktop.wait_for_selector('.finger[data-word="unknown"]', timeout=60_000)
        desktop.wait_for_timeout(1200)
        desktop.screenshot(path=folder / "view-desktop.png")
        desktop.close()
        phone = browser.new_page(viewport={"width": 390, "height": 844}, color_scheme="dark")
        phone.goto(server.url)
        phone.wait_for_selector('.finger[data-word="silent"], .finger[data-word="stale"]', timeout=60_000)
        phone.wait_for_timeout(2500)
        phone.screenshot(path=folder / "view-phone.png")
        phone.close()
        server.close()
    source = scene_source(shipped_folder("scenes") / "grooves.toml", Finger, 3, 0.0, None)
    server = ViewServer(source, Guard(), ("127.0.0.1",))
    server.start()
    page = browser.new_page(viewport={"width": 1280, "height": 1000}, color_scheme="dark")
    page.goto(server.url)
    page.select_option("#what", "gauges")
    page.wait_for_timeout(1500)
    page.click("#play")
    page.locator(".chart").first.hover(position={"x": 300, "y": 60})
    page.wait_for_timeout(500)
    page.screenshot(path=folder / "view-recording.png")
    page.close()
    server.close()
    for name in ("desktop", "phone", "recording"):
        shrink(folder / f"view-{name}.png")
        print(folder / f"view-{name}.png")


def shrink(path: Path) -> None:
    """The same picture in fewer bytes."""
    from PIL import Image

    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.save(path, optimize=True)


if __name__ == "__main__":
    main()
