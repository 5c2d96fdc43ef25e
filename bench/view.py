"""The web page under load: pictures a second at 15 fingers, and whether the receive loop loses a sample by it.

    python -m bench.view                  the measurement; about a minute
    python -m bench.view --screenshots    docs/figures/view-*.png, from the simulated hand

A process of its own sends SYNC, contact and gauge PDOs of all fingers through a loopback socket into the live receive
path; the page runs in headless Chromium. "lost rows" are SYNCs that did not become a whole row."""

import contextlib
import math
import shutil
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from bench.loopback import bound_receiver, sending
from bench.measure import ROOT, Meter, arguments, machine, table
from playwright.sync_api import Browser, sync_playwright
from websockets.sync.client import connect

from tipforce.host.live.receive import SocketReceiver
from tipforce.host.live.receiver import ReceiverGroup
from tipforce.scene import beam_calibration
from tipforce.watching.feeds import Finger, FrameFeed, with_layout
from tipforce.watching.frame_sources import BusSource
from tipforce_tools.page.guard import Guard
from tipforce_tools.page.server import ViewServer
from tipforce_tools.page.sources import LiveSource, Source

FINGERS, SYNC_HZ, SECONDS = 15, 400, 10.0
HEADER = ["browsers", "pictures/s", "frames dropped", "lost rows", "CPU share"]
_FRAME = struct.Struct("=IB3x8s")
_SETTLE_S = 3.0


def main() -> None:
    args = arguments(__doc__, "--screenshots").parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise SystemExit("Chromium is not there: tools/bootstrap.sh test installs it")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        if args.screenshots:
            screenshots(browser, ROOT / "docs" / "figures")
        else:
            print(machine())
            print(f"{FINGERS} fingers, {SYNC_HZ} Hz, {(2 * FINGERS + 1) * SYNC_HZ} frames/s, {SECONDS:g} s each")
            runs = (("one", 0), ("one, and two that do not read", 2))
            print(table(HEADER, [[name, *one_run(browser, idle)] for name, idle in runs]))
        browser.close()


def one_run(browser: Browser, idle: int) -> list[str]:
    """The cells of one line, beside so many browsers that do not read."""
    calibration = beam_calibration(pull=False)
    bus = bound_receiver()
    feed = FrameFeed(
        BusSource(ReceiverGroup([SocketReceiver(bus, "loopback")])),
        lambda node_id: with_layout(Finger(node_id, f"finger {node_id}", calibration), "I", None),
    )
    source = LiveSource(feed, "bench")
    server = ViewServer(source, Guard(), ("127.0.0.1",))
    server.start()
    sent_s = SECONDS + 2 * _SETTLE_S + 4.0
    with sending(bus, SYNC_HZ, sent_s, sync_frames, wait_s=0.0), contextlib.ExitStack() as stack:
        time.sleep(_SETTLE_S)
        for _ in range(idle):
            stack.enter_context(silent_reader(server.guard.port))
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(server.url)
        page.wait_for_function("() => window.tipforce.drawn > 10")
        before, meter = page.evaluate("window.tipforce.drawn"), Meter()
        page.wait_for_timeout(1000 * SECONDS)
        elapsed_s, share, after = meter.elapsed_s, meter.share, page.evaluate("window.tipforce.drawn")
        page.close()
    time.sleep(0.5)  # what has come is taken in
    whole = source.model.counters.rows
    lost = feed.frames // (2 * FINGERS + 1) - whole
    server.close()
    dropped = source.model.counters.dropped
    source.close()
    return [f"{(after - before) / elapsed_s:.1f}", str(dropped), f"{lost} of {whole}", f"{share:.2f}"]


@contextlib.contextmanager
def silent_reader(port: int) -> Iterator[None]:
    """A page that asks for the stream and then reads nothing."""
    with connect(f"ws://127.0.0.1:{port}/live", max_queue=1, ping_interval=None) as page:
        page.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        page.send('{"do": "stream", "bin": 2}')
        yield


def sync_frames(first: int, until: int) -> list[bytes]:
    """The frames of these SYNCs, all answers included."""
    frames = []
    for k in range(first, until):
        frames.append(_FRAME.pack(0x80, 0, b""))
        for node_id in range(1, FINGERS + 1):
            angle = 0.9 * k / SYNC_HZ + node_id
            theta = round(9000 + 4000 * math.sin(angle))
            P = round(2500 + 1500 * math.sin(1.7 * angle))
            strain = [round(2000 * math.sin(angle + n)) for n in range(3)]
            for base, values in ((0x280, (P, theta - 18000, theta)), (0x180, strain)):
                data = struct.pack("<hhhBB", *values, 3, k % 256)
                frames.append(_FRAME.pack(base + node_id, 8, data))
    return frames


def screenshots(browser: Browser, folder: Path) -> None:
    """The demo's hand, light on a desktop while a finger has a fault, and dark on a phone; and a recording."""
    from tipforce.shipped_files import shipped_folder
    from tipforce.watching.feeds import finger_maker
    from tipforce_tools.page.sources import scene_source

    hand, grooves = (
        scene_source(shipped_folder("scenes") / f"{name}.toml", finger_maker()) for name in ("hand", "grooves")
    )
    screenshot(browser, hand, (1280, 900), "light", 9.0, folder / "view-desktop.png")
    screenshot(browser, hand, (390, 844), "dark", 5.0, folder / "view-phone.png")
    screenshot(browser, grooves, (1280, 1000), "dark", 1.0, folder / "view-recording.png", gauges=True)


def screenshot(
    browser: Browser, source: Source, size: tuple[int, int], scheme: Literal["light", "dark"], t_s: float, path: Path,
    gauges: bool = False,
) -> None:  # fmt: skip
    """Write the page as it shows a moment of a recording, in few bytes."""
    from PIL import Image

    server = ViewServer(source, Guard(), ("127.0.0.1",))
    server.start()
    page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
    page.goto(server.url)
    if gauges:
        page.select_option("#what", "gauges")
    page.wait_for_function("() => window.tipforce.drawn > 10")
    page.evaluate(
        "t => { const scrub = document.getElementById('scrub'); scrub.value = Number(scrub.min) + 1000 * t;"
        " scrub.dispatchEvent(new Event('input')); }",
        t_s,
    )
    page.wait_for_timeout(1500)
    if gauges:
        page.locator(".chart").first.hover(position={"x": 300, "y": 60})
    page.screenshot(path=path)
    page.close()
    server.close()
    with Image.open(path) as image:
        small = image.convert("RGB")
    small.save(path, optimize=True)
    print(path)


if __name__ == "__main__":
    main()
