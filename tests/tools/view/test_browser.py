"""The page in a real browser, headless Chromium: live, pause, scrub, replay, faults, tare, keyboard, export."""

import contextlib
import re
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tipforce.host.frames.frame_array import frame_array
from tipforce.samples.reasons import NO_ANSWER
from tipforce.sensor.contact.scalar import CALIBRATED, CONTACT_PRESENT, FRONT_END_FAULT, OUTSIDE_PAD
from tipforce.shipped_files import file_or_shipped
from tipforce.watching.feeds import Finger, finger_maker
from tipforce_tools.page.server import ViewServer
from tipforce_tools.page.sources import LogSource, Source, scene_source
from tools.decode.logs import write_frames
from tools.view.support import MovingSource, serving
from tools.view.test_watcher import cycle

WAIT_MS = 60_000
GOOD = CONTACT_PRESENT | CALIBRATED


@contextlib.contextmanager
def opened(browser: Browser, source: Source, rules: dict[str, bool] | None = None, **options: Any) -> Iterator[Page]:
    """The page of a source, which is waited for as long as a loaded machine needs."""
    with serving(source, **(rules or {})) as server, contextlib.closing(browser.new_page(**options)) as page:
        page.set_default_timeout(WAIT_MS)
        page.goto(server.url)
        yield page


class Shown:
    def __init__(self, source: MovingSource, server: ViewServer, page: Page) -> None:
        self.source, self.server, self.page = source, server, page
        self.wrong: list[str] = []
        page.on("pageerror", lambda error: self.wrong.append(str(error)))
        page.on("console", lambda message: self.wrong.append(message.text) if message.type == "error" else None)
        page.goto(server.url)

    def word(self, node_id: int, text: str) -> None:
        expect(self.page.locator(f'.finger[data-node="{node_id}"] .state')).to_contain_text(text)

    def mode(self, text: str) -> None:
        expect(self.page.locator("#mode")).to_contain_text(text)

    def force(self, node_id: int) -> str:
        return self.page.locator(f'.finger[data-node="{node_id}"] .n').first.inner_text()


@pytest.fixture
def shown(browser: Browser, request: pytest.FixtureRequest) -> Iterator[Shown]:
    """A page of a moving source; parametrize indirectly with the server's rules."""
    source = MovingSource(3)
    with serving(source, **getattr(request, "param", {})) as server:
        page = browser.new_page(viewport={"width": 1280, "height": 900}, color_scheme="light")
        page.set_default_timeout(WAIT_MS)
        found = Shown(source, server, page)
        found.word(1, "live")
        yield found
        page.close()
        assert found.wrong == []


def test_live_pause_scrub_and_replay(shown: Shown) -> None:
    page = shown.page
    shown.mode("live")
    shown.word(1, "live")
    shown.source.P[0] = 3.0
    expect(page.locator(".finger .n").first).to_contain_text("3.0")
    shown.source.model.add_event(0, 1, "heartbeat_back", "heartbeat received, operational")
    page.click("#play")
    shown.mode("paused")
    shown.word(1, "recorded")
    expect(page.locator(".finger .words").first).to_contain_text("node operational")
    still = shown.force(1)
    shown.source.P[0] = 4.0
    page.wait_for_timeout(400)
    assert shown.force(1) == still
    # Scrub to the beginning, where it was 1 N, with the keyboard.
    page.focus("#scrub")
    page.keyboard.press("Home")
    expect(page.locator(".finger .n").first).to_contain_text("1.0")
    before = page.inner_text("#when")
    page.keyboard.press("ArrowRight")
    page.wait_for_function("text => document.getElementById('when').textContent !== text", arg=before)
    page.click("#play")
    shown.mode("replay")
    page.wait_for_function("text => document.getElementById('when').textContent !== text", arg=page.inner_text("#when"))
    page.click("#live")
    shown.mode("live")
    expect(page.locator(".finger .n").first).to_contain_text("4.0")


def test_faults_are_shown_and_nothing_stale_as_live(shown: Shown) -> None:
    shown.word(2, "live")
    shown.source.status[1] = CALIBRATED | FRONT_END_FAULT
    shown.word(2, "unknown: front-end fault")
    assert "unknown" in shown.force(2)
    shown.source.model.add_event(shown.source.model.now_ns(), 2, "emcy", "0x5030 front end")
    expect(shown.page.locator("#events li").first).to_contain_text("0x5030")
    shown.source.status[1] = NO_ANSWER
    shown.word(2, "stale since")
    shown.word(2, "no response")
    shown.word(1, "live")
    shown.source.status[1] = GOOD
    shown.word(2, "live")
    shown.source.stopped = True
    shown.word(1, "stale since")
    shown.word(3, "no response")


def test_a_server_that_falls_silent_is_not_live(shown: Shown) -> None:
    wake = threading.Event()
    shown.server.loop.call_soon_threadsafe(wake.wait, 4 * WAIT_MS / 1000)
    shown.mode("not live")
    shown.word(1, "stale since")
    expect(shown.page.locator("#alarm")).to_be_visible()
    wake.set()
    shown.mode("live")
    shown.word(1, "live")


@pytest.mark.parametrize("paused", [False, True])
def test_a_page_connects_again(browser: Browser, paused: bool) -> None:
    """To the same server, and to another one at the same address, whose hand has other fingers."""
    with serving(MovingSource(3)) as server:
        port = server.guard.port
        page = browser.new_page()
        page.goto(server.url)
        expect(page.locator("#mode")).to_have_text("live")
        if paused:
            page.click("#play")
    expect(page.locator("#mode")).to_have_text("paused" if paused else "not live")
    with serving(MovingSource(2), port=port):
        expect(page.locator(".finger")).to_have_count(2)
        page.evaluate("document.getElementById('live').click()")
        expect(page.locator("#mode")).to_have_text("live")
        expect(page.locator("#alarm")).to_be_hidden()
        page.close()


def test_a_finger_that_is_found_while_the_page_is_paused_gets_a_card(shown: Shown) -> None:
    model, page = shown.source.model, shown.page
    page.click("#play")
    shown.mode("paused")
    model.fingers = tuple(replace(finger, node_id=finger.node_id + 1) for finger in model.fingers)
    shown.source.pump = lambda: None  # type: ignore[method-assign]
    model.set_fingers((Finger(1), *model.fingers))
    page.focus("#scrub")
    page.keyboard.press("Home")
    shown.word(1, "no response")
    expect(page.locator('.finger[data-node="2"] .n').first).to_have_text(re.compile(r"^(0\.9|1\.0)"))


def test_more_than_six_tabs_are_live(browser: Browser) -> None:
    with serving(MovingSource(1)) as server, browser.new_context() as context:
        context.set_default_timeout(WAIT_MS)
        pages = [context.new_page() for _ in range(8)]
        for page in pages:
            page.goto(server.url)
        for page in pages:
            expect(page.locator("#mode")).to_have_text("live")
            expect(page.locator(".finger .state")).to_contain_text("live")


@pytest.mark.parametrize("shown", [{"allow_writes": True}], indirect=True)
def test_tare_asks_first(shown: Shown) -> None:
    page = shown.page
    shown.word(1, "live")
    page.locator(".tare").first.click()
    page.get_by_role("button", name="Cancel").click()
    assert shown.source.tared == []
    page.locator(".tare").first.click()
    expect(page.locator("#confirm")).to_contain_text("Unload the fingertip")
    page.get_by_role("button", name="Tare now").click()
    expect(page.locator("#note")).to_contain_text("f1: tared")
    assert shown.source.tared == [1]


def test_everything_by_keyboard_with_a_visible_focus(shown: Shown) -> None:
    page = shown.page
    seen = []
    for _ in range(18):
        page.keyboard.press("Tab")
        seen.append(
            page.evaluate(
                """() => { const e = document.activeElement, s = getComputedStyle(e);
                return [e.id || e.className, s.outlineStyle !== "none" && parseFloat(s.outlineWidth) >= 1]; }"""
            )
        )
    names = [name for name, _ in seen]
    offered = ("newtons", "microstrain", "what", "window", "closer", "wider")
    for wanted in ("png", "csv", "theme", "pick", *offered, "events", "play", "scrub"):
        assert wanted in names, names
    assert all(visible for name, visible in seen if name), seen
    page.locator(".pick").nth(2).focus()
    page.keyboard.press("Enter")
    expect(page.locator("#charted")).to_have_text("Contact over time: f3")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Space")
    shown.mode("paused")


def test_it_fits_a_phone_and_follows_the_theme(shown: Shown) -> None:
    page = shown.page
    page.set_viewport_size({"width": 390, "height": 844})
    shown.word(1, "live")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    colours = "getComputedStyle(document.body).backgroundColor + getComputedStyle(document.documentElement).color"
    light = page.evaluate(colours)
    page.select_option("#theme", "dark")
    assert page.evaluate(colours) != light
    assert page.evaluate("[...document.querySelectorAll('.finger canvas')].every(c => c.getAttribute('aria-label'))")


def test_a_log_is_replayed_to_its_end(browser: Browser, tmp_path: Path) -> None:
    """Of 15 s: a loaded machine shows the states between, too."""
    frames = [frame for k in range(1500) for frame in cycle(k, (1,) if 150 <= k < 1200 else (1, 2))]
    source = LogSource(write_frames(tmp_path / "run.log", frame_array(frames)), Finger)
    with opened(browser, source) as page:
        mode, second = page.locator("#mode"), page.locator('.finger[data-node="2"] .state')
        expect(mode).to_contain_text("replay")  # it opens playing, as a whole
        expect(page.locator("#live")).to_be_hidden()
        expect(page.locator("#window")).to_have_value("0")
        page.focus("#scrub")
        page.keyboard.press("Home")
        expect(mode).to_have_text("paused")
        expect(second).to_have_text("recorded")
        page.select_option("#speed", "0.1")  # not at its end before the click that pauses it
        page.click("#play")
        expect(mode).to_contain_text("replay")
        page.click("#play")
        expect(mode).to_have_text("paused")
        page.select_option("#speed", "1")
        page.click("#play")
        expect(mode).to_contain_text("replay")
        expect(second).to_contain_text("stale since")
        page.select_option("#speed", "16")
        expect(mode).to_have_text("ended")
        expect(page.locator(".finger .n").nth(3)).to_contain_text("3.499")
        page.select_option("#speed", "1")
        page.click("text=Play again")
        expect(mode).to_contain_text("replay")
        expect(page.locator("#play")).to_have_text("Pause")
        page.select_option("#speed", "16")
        expect(mode).to_have_text("ended")
        page.focus("#scrub")
        page.keyboard.press("Home")
        expect(mode).to_have_text("paused")
        expect(page.locator("#play")).to_have_text("Play")


@pytest.mark.parametrize("loops", [True, False], ids=["loops", "ends"])
def test_a_scene_loops_or_ends_on_its_best_moment(browser: Browser, loops: bool) -> None:
    source = scene_source(file_or_shipped("hand", "scenes"), finger_maker(), 8.0, 9.0)
    source.loops = loops
    with opened(browser, source, viewport={"width": 1280, "height": 900}) as page:
        expect(page.locator("#frames")).to_contain_text("sim0")
        expect(page.locator("#python")).to_contain_text("tipforce.read_log")
        if loops:
            page.evaluate(
                "() => { window.ended = 0; new MutationObserver(() => { window.ended += 1; })"
                ".observe(document.getElementById('mode'), {childList: true, characterData: true, subtree: true}); }"
            )
            before = page.evaluate("() => window.tipforce.messages")
            page.wait_for_function("before => window.tipforce.messages > before + 60", arg=before)  # 1 s has 33 at most
            assert page.evaluate("() => window.ended") == 0  # it has played on
            expect(page.locator("#mode")).to_contain_text("replay")
        else:
            expect(page.locator("#mode")).to_contain_text("paused")
            assert source.rest_ns is not None
            shown = page.evaluate("() => Number(document.getElementById('scrub').value)")
            assert abs(shown - source.rest_ns / 1e6) < 20.0


def test_exports(shown: Shown, tmp_path: Path) -> None:
    page = shown.page
    expect(page.locator(".tare")).to_have_count(0)  # it is read-only
    shown.source.status[1] = GOOD | OUTSIDE_PAD
    expect(page.locator(".finger .flag")).to_have_text("theta outside the pad")
    spy = "it.fillText = function (...all) { texts.push(all[0]); draw.apply(this, all); }"
    page.evaluate(f"() => {{ const it = CanvasRenderingContext2D.prototype, draw = it.fillText; texts = []; {spy} }}")
    with page.expect_download() as picture:
        page.click("#png")
    assert "live, push, theta outside the pad" in page.evaluate("texts")
    path = tmp_path / "view.png"
    picture.value.save_as(path)
    content = path.read_bytes()
    assert content.startswith(b"\x89PNG")
    assert int.from_bytes(content[16:20]) == 2560
    with page.expect_download() as table:
        page.click("#csv")
    table.value.save_as(tmp_path / "view.csv")
    assert (tmp_path / "view.csv").read_text().startswith("t_s,node_id,name,P_N")


SPAN = "[window.tipforce.panel.from, window.tipforce.panel.to]"


def recording(path: Path, rows: int = 200) -> LogSource:
    """A log of two fingers over two seconds, with gauges."""
    frames = [frame for k in range(rows) for frame in cycle(k, (1, 2))]
    return LogSource(write_frames(path / "run.log", frame_array(frames)), Finger)


def test_scrubbing_and_zoom_keep_what_follows_visible(browser: Browser, tmp_path: Path) -> None:
    source = recording(tmp_path)
    start, end = (ns / 1e6 for ns in source.model.span_ns())
    whole = [pytest.approx(start), pytest.approx(end)]
    with opened(browser, source, viewport={"width": 1280, "height": 1200}) as page:
        expect(page.locator("#mode")).to_have_text("ended")
        assert page.evaluate(SPAN) == whole
        chart = page.locator(".chart").first
        box = chart.bounding_box()
        assert box is not None
        left, width = box["x"] + 46, box["width"] - 46 - 62
        page.mouse.click(left + 0.5 * width, box["y"] + 50)
        page.wait_for_function(
            "t => Math.abs(Number(document.getElementById('scrub').value) - t) < 60", arg=(start + end) / 2
        )
        assert page.evaluate(SPAN) == whole
        page.mouse.move(left + 0.25 * width, box["y"] + 50)  # a drag selects half of it
        page.mouse.down()
        page.mouse.move(left + 0.5 * width, box["y"] + 50, steps=4)
        page.mouse.move(left + 0.75 * width, box["y"] + 50, steps=4)
        page.mouse.up()
        span = end - start
        wanted = [pytest.approx(start + share * span, abs=0.02 * span) for share in (0.25, 0.75)]
        assert page.evaluate(SPAN) == wanted
        page.click("#wider")
        low, high = page.evaluate(SPAN)
        assert high - low == pytest.approx(span, rel=0.05)
        page.click("#whole")
        assert page.evaluate(SPAN) == whole


# The changed pixels' bounds when this force is drawn, in a drawing as large as one of five on a laptop.
ARROW = """async ({ P, phi, theta }) => {
  const { drawSection } = await import('./section.js'), geometry = window.tipforce.panel.page.setup.fingers[0];
  const [width, height] = [218, 242], drawn = [P, null].map((P) => {
    const context = new OffscreenCanvas(width, height).getContext('2d'), scale = { newtons: 5, fullStrain: 500 };
    const state = { word: 'live', P, phi, theta, uP: null, uPhi: null, uTheta: null, gauges: null };
    drawSection(context, geometry, state, scale, 0, 0, width, height);
    return new Uint32Array(context.getImageData(0, 0, width, height).data.buffer);
  });
  const at = [...drawn[0].keys()].filter((k) => drawn[0][k] !== drawn[1][k]);
  const [x, y] = [at.map((k) => k % width), at.map((k) => Math.floor(k / width))];
  return [Math.min(...x), Math.min(...y), width - 1 - Math.max(...x), height - 1 - Math.max(...y)];
}"""


def test_an_arrow_is_long_and_never_leaves_its_drawing(shown: Shown) -> None:
    tops = [shown.page.evaluate(ARROW, {"P": P, "phi": -90, "theta": 90})[1] for P in (3.0, 5.0)]
    assert 3 * (tops[0] - tops[1]) / 2 >= 70  # pixels for 3 N
    for theta in range(0, 181, 30):
        for phi in range(-180, 181, 30):
            for P in (5.0, 50.0):
                assert min(shown.page.evaluate(ARROW, {"P": P, "phi": phi, "theta": theta})) >= 1, (P, phi, theta)


def test_gauges_and_forces_are_charted_with_fixed_scales(shown: Shown) -> None:
    page = shown.page
    expect(page.locator("#newtons")).to_have_value("5")
    for what, charts, label in (
        ("gauges", 1, "gauges of f1"),
        ("forces", 1, "forces F1, F2, F3 of f1"),
        ("contact", 3, "force P"),
    ):
        page.select_option("#what", what)
        expect(page.locator(".chart")).to_have_count(charts)
        assert label in str(page.locator(".chart").first.get_attribute("aria-label"))
        page.wait_for_function("() => window.tipforce.panel.bins.rows.size > 5")
        row = page.evaluate("[...window.tipforce.panel.bins.rows.values()].at(-1)")
        assert len(row) == 3 * 10  # three fingers, each with three quantities
        if what == "gauges":
            assert row[:3] == [100.0, 100.0, 100.0]
    shown.source.P[0] = 30.0
    expect(page.locator(".finger .n").first).to_contain_text("30.0")
    expect(page.locator("#newtons")).to_have_value("5")
    page.select_option("#newtons", "fit")
    expect(page.locator("#newtons")).to_have_value("50")


AXE = Path(sys.prefix) / "axe/node_modules/axe-core/axe.min.js"


def test_axe_finds_nothing(browser: Browser, tmp_path: Path) -> None:
    """On a desktop and a phone; a live page in the light, a recording in the dark."""
    assert AXE.is_file(), "axe-core is missing: tools/bootstrap.sh test installs it"
    found = []
    for dark, source in ((False, MovingSource(2)), (True, recording(tmp_path, 20))):
        with opened(browser, source, {"allow_writes": True}, color_scheme="dark" if dark else "light") as page:
            expect(page.locator(".finger")).to_have_count(2)
            page.evaluate(AXE.read_text())
            for width in (1280, 390):
                page.set_viewport_size({"width": width, "height": 844})
                rules = page.evaluate("axe.run()")["violations"]
                found += [(dark, width, rule["id"], rule["nodes"][0]["html"]) for rule in rules]
                assert page.evaluate("document.documentElement.scrollWidth") <= width
            top = page.evaluate("document.getElementById('fingers').getBoundingClientRect().top")
            assert top < 120  # on a phone the fingers are first
    assert found == []
