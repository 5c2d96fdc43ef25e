"""The server over real sockets: who may ask for what, answers, streams; who reads nothing holds up nobody."""

import contextlib
import itertools
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import CloseCode

from tipforce.errors import InputError
from tipforce.sensor.contact.scalar import CONTACT_PRESENT
from tipforce_tools.page import connection as view_page
from tipforce_tools.page import server as view_server
from tipforce_tools.page.guard import CONTENT_SECURITY_POLICY, Guard, access_token, host_names
from tipforce_tools.page.server import MAX_OTHERS, MAX_PAGES, ViewServer, static_files
from tools.rig import until
from tools.view.support import WAIT_S, MovingSource, Page, fingers, get, serving


def test_files_and_headers() -> None:
    with serving(MovingSource()) as server:
        for path in ("/", *static_files(), "/nothing", "/live"):
            _, headers, body = get(server, path)
            assert headers["content-security-policy"] == CONTENT_SECURITY_POLICY
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["referrer-policy"] == "no-referrer"
            assert headers["cache-control"] == "no-store"
            assert "set-cookie" not in headers
            assert b"http://" not in body.replace(b"http://www.w3.org/2000/svg", b"")  # nothing from elsewhere
        assert get(server, "/")[1]["content-type"].startswith("text/html")
        assert get(server, "/", "HEAD")[2] == b""


def test_the_page_needs_nothing_that_its_policy_forbids() -> None:
    kind, html = static_files()["/"]
    assert kind.startswith("text/html")
    assert b"style=" not in html
    assert b"onclick" not in html
    assert html.count(b"<script") == 1
    for name, (_, content) in static_files().items():
        if name.endswith(".js"):
            assert b"innerHTML" not in content
            assert b"eval(" not in content


def test_no_other_file_can_be_named() -> None:
    with serving(MovingSource()) as server:
        for path in (
            "/../model.py", "/..%2fmodel.py", "/static/../model.py", "//etc/passwd", "/%2e%2e/%2e%2e/etc/passwd",
            "/main.js/../../model.py", "/./main.js", "/etc/passwd", "/main.js%00.html", "\\..\\model.py",
        ):  # fmt: skip
            assert get(server, path)[0] == 404, path


def handshake(server: ViewServer, **options: Any) -> int:
    """Status of the handshake of a WebSocket that is refused."""
    with pytest.raises(InvalidStatus) as refused, Page(server, **options):
        pass
    return refused.value.response.status_code


def test_other_names_and_origins_are_refused() -> None:
    with serving(MovingSource(), allow_writes=True) as server:
        assert get(server, "/", Host="evil.example")[0] == 421
        assert get(server, "/", Host=None)[0] == 421
        assert get(server, "/", Origin="http://evil.example")[0] == 403
        assert get(server, "/", "PUT")[0] == get(server, "/", "POST")[0] == 405
        for origin in ("http://evil.example", "null", f"http://localhost:{server.guard.port}"):
            assert handshake(server, origin=origin) == 403
        assert handshake(server, additional_headers={"Sec-Fetch-Site": "cross-site"}) == 403
        with socket.create_connection(("127.0.0.1", server.guard.port), timeout=WAIT_S) as raw:
            raw.sendall(b"GET /live HTTP/1.1\r\nHost: evil.example\r\nHost: 127.0.0.1\r\n\r\n")
            assert raw.recv(100).startswith(b"HTTP/1.1 400 ")


def test_tare_only_where_it_is_allowed() -> None:
    source = MovingSource()
    read_only = "read-only: start it with --allow-writes"
    with serving(source) as server, Page(server) as page:
        assert page.ask("tare", node_id=1) == read_only
        assert page.ask("setup")["no_tare"] == read_only
    with serving(source, allow_writes=True) as server:
        with Page(server, origin=None) as page:
            assert page.ask("tare", node_id=1) == "a page that writes needs an Origin"
        assert source.tared == []
        with Page(server) as page:
            assert page.ask("setup")["no_tare"] == ""
            assert page.ask("tare", node_id=1) == {"text": "tared"}
            assert source.tared == [1]
            assert page.ask("tare", node_id=3) == "node 3: the force is unknown"
            assert page.ask("tare", node_id=9) == "node-id 9: no finger of this page"
    with serving(MovingSource(no_tare="a log can't be tared"), allow_writes=True) as server, Page(server) as page:
        assert page.ask("tare", node_id=1) == "a log can't be tared"
    assert source.tared == [1]


def test_a_token_opens_the_page_once_and_becomes_a_cookie() -> None:
    token = "abcdefghijklmnop-1"
    with serving(MovingSource(), access_token=token) as server:
        assert get(server, "/")[0] == 401
        assert handshake(server) == 401
        status, headers, _ = get(server, f"/?token={token}")
        assert (status, headers["location"]) == (303, "/")
        cookie = headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        cookie = cookie.split(";")[0]
        assert get(server, "/", Cookie=cookie)[0] == 200
        assert server.url.endswith(f"/?token={token}")
        with Page(server, additional_headers={"Cookie": cookie}) as page:
            assert page.ask("setup")["title"] == "test hand"


WRONG = [
    "", "{", "[]", "\udcff".encode("utf-8", "surrogatepass"), '{"do": "at"}', '{"do": "nothing"}', '{"id": 1}',
    '{"do": "at", "t": "x"}', '{"do": "at", "t": -1}', '{"do": "at", "t": 1e999}',
    '{"do": "history", "start": 0, "end": 1e12, "bin": 1}', '{"do": "history", "start": 500, "end": 1, "bin": 1}',
    '{"do": "history", "start": 0, "end": 1, "bin": 1e99}', '{"do": "stream", "bin": 0}',
    '{"do": "stream", "start": 1, "speed": 0}', '{"do": "setup", "more": 1}', '{"do": "tare", "node_id": "1"}',
    '{"do": "tare", "node_id": null}', '{"do": "tare", "node_id": 1.5}', '{"more": ' + "[" * 2000,
]  # fmt: skip


def test_wrong_requests_are_refused() -> None:
    source = MovingSource()
    with serving(source, allow_writes=True) as server, Page(server) as page:
        for message in WRONG:
            page.socket.send(message)
            assert page.receive()["error"], message
            assert page.ask("setup")["title"] == "test hand"  # the page goes on
    assert source.tared == []


@contextlib.contextmanager
def closed_with(code: int) -> Iterator[None]:
    with pytest.raises(ConnectionClosed) as closed:
        yield
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == code


def test_a_long_request_ends_the_connection() -> None:
    with serving(MovingSource()) as server, Page(server) as page:
        page.socket.send(" " * 5000)
        with closed_with(CloseCode.MESSAGE_TOO_BIG):
            page.receive()


def test_the_stream_is_live_and_the_past_can_be_asked_for() -> None:
    source = MovingSource(2)
    with serving(source) as server, Page(server) as page:
        time.sleep(0.1)
        messages = page.stream(12)
        assert [message["t"] for message in messages] == sorted(message["t"] for message in messages)
        assert messages[-1]["fingers"][1]["w"] == "live"
        assert messages[-1]["fingers"][1]["c"][0] == pytest.approx(2.0, abs=0.06)
        t = messages[-1]["t"]
        assert page.ask("at", t=messages[5]["end"])["fingers"][0]["w"] == "live"
        found = page.ask("history", start=t - 1000, end=t, bin=20)
        assert len(found["i"]) == len(found["v"]) > 5
        assert all(len(row) == 20 for row in found["v"])
        source.status[1] = CONTACT_PRESENT | 128
        time.sleep(0.15)
        assert page.stream(2)[-1]["fingers"][1]["why"] == "front-end fault"
        source.stopped = True
        time.sleep(0.3)
        assert [f["w"] for f in page.stream(1)[0]["fingers"]] == ["stale", "stale"]


def test_a_paused_page_gets_nothing() -> None:
    with serving(MovingSource()) as server, Page(server) as page:
        page.stream(3)
        assert page.ask("pause") == {}
        with pytest.raises(TimeoutError):
            page.socket.recv(0.3)
        assert len(page.stream(3)) == 3


def test_the_buffer_as_csv() -> None:
    source = MovingSource(2)
    with serving(source) as server, Page(server) as page:
        time.sleep(0.2)
        source.stopped = True
        time.sleep(0.1)
        number, content = page.send("csv"), b""
        while isinstance(part := page.socket.recv(WAIT_S), bytes):
            content += part
        assert json.loads(part) == {"id": number, "answer": {"bytes": len(content)}}
        lines = content.decode().splitlines()
        assert lines[0].startswith("t_s,node_id,name,P_N,phi_deg,theta_deg,u_P_N")
        assert len(lines) == 1 + 2 * source.model.counters.rows
        assert lines[2].split(",")[1:6] == ["2", "f2", lines[2].split(",")[3], "-90", "90"]
    chunks = view_page.csv_chunks(source.model)
    next(chunks)
    source.model.set_fingers(fingers(3))
    with pytest.raises(InputError, match="a finger was found meanwhile"):
        next(chunks)


def test_a_page_that_does_not_read_slows_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_page, "SEND_TIMEOUT_S", 0.5)
    source = MovingSource(3)
    with serving(source) as server, Page(server, ping_interval=None) as slow:
        slow.socket.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.send("stream", bin=1)
        before = source.model.counters.rows
        with Page(server) as page:
            messages = page.stream(30)
            assert source.model.counters.rows > before + 50
            assert messages[-1]["fingers"][0]["w"] == "live"
            until(lambda: len(server.pages) == 1)  # it is dropped in the end; the page goes on
            assert page.ask("setup")["title"] == "test hand"


def test_a_page_that_breaks_off_is_no_error(caplog: pytest.LogCaptureFixture) -> None:
    with serving(MovingSource()) as server:
        with Page(server) as page:
            page.stream(2)
            page.socket.socket.shutdown(socket.SHUT_RDWR)
        until(lambda: not server.pages)
    assert [record.getMessage() for record in caplog.records if record.levelname not in ("DEBUG", "INFO")] == []


def test_no_number_of_connections_locks_others_out() -> None:
    with serving(MovingSource()) as server, contextlib.ExitStack() as stack:
        # Some say nothing; pages say what they want, and then take nothing.
        for _ in range(2 * MAX_OTHERS):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.guard.port), timeout=WAIT_S))
        assert get(server, "/")[0] == 200
        pages = [stack.enter_context(Page(server)) for _ in range(MAX_PAGES)]
        assert pages[-1].ask("setup")["title"] == "test hand"
        time.sleep(1.1)
        assert len(stack.enter_context(Page(server)).stream(3)) == 3
        assert len(server.pages) == MAX_PAGES


def test_there_is_a_limit_of_pages_that_are_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tipforce_tools.page.server._SLOW_S", 3600.0)  # a busy machine makes no page slow
    with serving(MovingSource()) as server, contextlib.ExitStack() as stack:
        for _ in range(MAX_PAGES):
            stack.enter_context(Page(server)).ask("setup")
        with closed_with(CloseCode.TRY_AGAIN_LATER), Page(server) as page:
            page.receive()


def test_a_pump_that_fails_is_told() -> None:
    source = MovingSource()

    def fail() -> None:
        raise OSError("bus is gone")

    with serving(source) as server, Page(server) as page:
        source.pump = fail  # type: ignore[method-assign]
        until(lambda: source.model.error)
        assert page.ask("setup")["picture"]["error"] == "OSError: bus is gone"


FLOODS: dict[str, Callable[[Page], Any]] = {
    "streams": lambda page: page.socket.send(json.dumps({"do": "stream", "bin": 1})),
    "setups": lambda page: page.socket.send(json.dumps({"do": "setup"})),
    "errors": lambda page: page.socket.send("{"),
    "pings": lambda page: page.socket.ping(),
    "pongs": lambda page: page.socket.pong(),
    "parts": lambda page: page.socket.send(itertools.repeat("", 10)),
}
FLOODING, AT_ONCE = 4, 40


@pytest.mark.parametrize("kind", FLOODS)
def test_a_page_that_floods_is_closed_and_holds_up_nobody(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_server, "MESSAGES_AT_ONCE", float(AT_ONCE))
    monkeypatch.setattr(view_server, "MESSAGES_A_SECOND", 0.0)  # the clock of the machine does not count
    with serving(MovingSource()) as server, contextlib.ExitStack() as stack:
        flooding = [stack.enter_context(Page(server)) for _ in range(FLOODING)]
        closing = [threading.Thread(target=flood, args=(FLOODS[kind], page)) for page in flooding]
        for thread in closing:
            thread.start()
        page = stack.enter_context(Page(server))  # a new page gets its data meanwhile, and all of it
        assert page.ask("setup")["title"] == "test hand"
        assert len(page.stream(5)) == 5
        for thread in closing:
            thread.join()
        assert server.refused == FLOODING
        # What the server took from all of them is their budget, and the message that was too much.
        assert server.messages <= FLOODING * (AT_ONCE + 1) + 4
        assert page.ask("pause") == {}


def flood(send: Callable[[Page], Any], page: Page) -> None:
    """Send until the server closes the connection, and read nothing before: its reason may be lost on its way."""
    with contextlib.suppress(ConnectionClosed):
        for _ in range(100 * AT_ONCE):
            send(page)
    with contextlib.suppress(ConnectionClosed):
        while True:
            page.socket.recv(WAIT_S)


def test_a_page_that_is_closed_learns_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_server, "MESSAGES_AT_ONCE", 4.0)  # the handshake is one
    monkeypatch.setattr(view_server, "MESSAGES_A_SECOND", 0.0)
    with serving(MovingSource()) as server, Page(server) as page:
        for _ in range(3):
            page.ask("setup")
        with closed_with(CloseCode.POLICY_VIOLATION):
            page.ask("setup")
        assert server.refused == 1


def test_a_page_within_its_budget_goes_on() -> None:
    with serving(MovingSource()) as server, Page(server) as page:
        for _ in range(200):
            page.send("stream", bin=1)
        for _ in range(50):
            assert page.ask("setup")["title"] == "test hand"
        assert server.refused == 0


HOST = {"Host": "127.0.0.1:8404"}
ORIGIN = HOST | {"Origin": "http://127.0.0.1:8404"}


def status(guard: Guard, headers: dict[str, str], token: str = "") -> int:
    refusal = guard.check(headers, token)
    return HTTPStatus.OK if refusal is None else refusal[0]


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        (HOST, 200), ({"Host": "localhost:8404"}, 200), ({"Host": "[::1]:8404"}, 200), (ORIGIN, 200),
        ({}, 421), ({"Host": "127.0.0.1"}, 421), ({"Host": "127.0.0.1:80"}, 421), ({"Host": "evil.example:8404"}, 421),
        ({"Host": "127.0.0.1.evil.example:8404"}, 421), (HOST | {"Origin": "http://evil.example"}, 403),
        (HOST | {"Origin": "null"}, 403), (HOST | {"Origin": "https://127.0.0.1:8404"}, 403),
        (HOST | {"Origin": "http://localhost:8404"}, 403), (HOST | {"Sec-Fetch-Site": "cross-site"}, 403),
        (HOST | {"Sec-Fetch-Site": "same-site"}, 403), (HOST | {"Sec-Fetch-Site": "same-origin"}, 200),
    ],
)  # fmt: skip
def test_reading(headers: dict[str, str], expected: int) -> None:
    assert status(Guard(port=8404), headers) == expected


def test_beyond_loopback_everybody_needs_the_token() -> None:
    token = access_token("192.0.2.1", "auto")
    guard = Guard(host_names("192.0.2.1"), token, port=8404)
    host = {"Host": "192.0.2.1:8404"}
    assert status(guard, host) == 401
    assert status(guard, host, token) == 200
    assert status(guard, host, token[:-1]) == 401
    assert status(guard, host | {"Cookie": f"a=b; tipforce_access={token}"}) == 200
    assert status(guard, host | {"Cookie": "tipforce_access="}) == 401
    assert status(guard, {"Host": "127.0.0.1:8404"}, token) == 421
    with pytest.raises(InputError):
        access_token("192.0.2.1", "a" * 15 + "\n")
