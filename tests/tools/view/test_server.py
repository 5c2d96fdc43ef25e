"""The server over real sockets: security, answers, streams; a browser that does not read holds up nobody."""

from __future__ import annotations

import json
import socket
import time

import pytest

from tipforce_tools.view.blocks import CONTACT
from tipforce_tools.view.guard import CONTENT_SECURITY_POLICY, WRITE_HEADER
from tipforce_tools.view.server import ViewServer, static_files
from tools.view.support import MovingSource, ask, first_messages, serving


def post(server: ViewServer, node_id: object, **changes: str | None) -> tuple[int, dict[str, object]]:
    """A tare as the page asks for it, with other headers where the test says so."""
    headers: dict[str, str | None] = {
        "Origin": f"http://127.0.0.1:{server.guard.port}", WRITE_HEADER: server.guard.write_token,
        "Content-Type": "application/json",
    }  # fmt: skip
    status, _, body = ask(server, "/api/tare", "POST", json.dumps({"node_id": node_id}), **(headers | changes))
    return status, json.loads(body)


def test_files_and_headers() -> None:
    with serving(MovingSource()) as server:
        for path in ("/", *static_files(), "/api/setup", "/nothing", "/api/at?t=x"):
            _, headers, body = ask(server, path)
            assert headers["content-security-policy"] == CONTENT_SECURITY_POLICY
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["referrer-policy"] == "no-referrer"
            assert headers["cache-control"] == "no-store"
            assert "set-cookie" not in headers
            assert b"http://" not in body.replace(b"http://www.w3.org/2000/svg", b"")  # nothing from elsewhere
        assert ask(server, "/")[1]["content-type"].startswith("text/html")
        assert ask(server, "/", "HEAD")[2] == b""


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


@pytest.mark.parametrize(
    "path",
    ["/../command.py", "/..%2fcommand.py", "/static/../command.py", "//etc/passwd", "/%2e%2e/%2e%2e/etc/passwd",
     "/main.js/../../command.py", "/./main.js", "/etc/passwd", "/main.js%00.html", "\\..\\command.py"],
)  # fmt: skip
def test_no_other_file_can_be_named(path: str) -> None:
    with serving(MovingSource()) as server:
        assert ask(server, path)[0] == 404


def test_other_names_and_origins_are_refused() -> None:
    with serving(MovingSource(), allow_writes=True) as server:
        assert ask(server, "/api/setup", Host="evil.example")[0] == 421
        assert ask(server, "/api/setup", Host=None)[0] == 421
        assert ask(server, "/events", Origin="http://evil.example")[0] == 403
        assert post(server, 1, Origin="http://evil.example")[0] == 403
        assert ask(server, "/api/setup", "PUT")[0] == 501
        assert ask(server, "/api/setup", "OPTIONS")[0] == 501


def test_tare_only_where_it_is_allowed() -> None:
    source = MovingSource()
    with serving(source) as server:
        assert post(server, 1) == (403, {"error": "read-only: start it with --allow-writes"})
        setup = json.loads(ask(server, "/api/setup")[2])
        assert (setup["no_tare"], setup["token"]) == ("read-only: start it with --allow-writes", "")
    with serving(source, allow_writes=True) as server:
        assert json.loads(ask(server, "/api/setup")[2])["token"] == server.guard.write_token
        assert post(server, 1, **{WRITE_HEADER: None})[0] == 403
        assert post(server, 1, Origin=None)[0] == 403
        assert source.tared == []
        assert post(server, 1) == (200, {"text": "tared"})
        assert source.tared == [1]
        assert post(server, 3) == (409, {"error": "node 3: the force is unknown"})
        for wrong in (9, "1", None, 1.5):
            assert post(server, wrong)[0] == 400
        assert post(server, "1")[1] == {"error": "tare: node_id is '1': expected int, got str"}
        assert ask(server, "/api/setup", "POST", "{}", Origin=f"http://127.0.0.1:{server.guard.port}",
                   **{WRITE_HEADER: server.guard.write_token})[0] == 404  # fmt: skip
        assert source.tared == [1]
    with serving(MovingSource(no_tare="a log can't be tared"), allow_writes=True) as server:
        assert post(server, 1) == (403, {"error": "a log can't be tared"})


def test_a_token_opens_the_page_once_and_becomes_a_cookie() -> None:
    token = "abcdefghijklmnop-1"
    with serving(MovingSource(), access_token=token) as server:
        assert ask(server, "/")[0] == 401
        assert ask(server, "/api/setup")[0] == 401
        status, headers, _ = ask(server, f"/?token={token}")
        assert (status, headers["location"]) == (303, "/")
        cookie = headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        assert ask(server, "/", Cookie=cookie.split(";")[0])[0] == 200
        assert server.url.endswith(f"/?token={token}")


@pytest.mark.parametrize(
    "path",
    ["/api/at", "/api/at?t=nan", "/api/history?from=0&to=1e12&bin=1", "/api/history?from=500&to=1", "/events?bin=0",
     "/events?speed=0&from=1", "/events?bin=-1", "/api/history?from=0&to=1&bin=1e99"],
)  # fmt: skip
def test_wrong_numbers_are_refused(path: str) -> None:
    with serving(MovingSource()) as server:
        status, _, body = ask(server, path)
        assert status == 400
        assert json.loads(body)["error"]


def test_the_stream_is_live_and_the_past_can_be_asked_for() -> None:
    source = MovingSource(2)
    with serving(source) as server:
        time.sleep(0.1)
        messages = first_messages(server, "/events?bin=20", 12)
        assert [message["t"] for message in messages] == sorted(message["t"] for message in messages)
        assert messages[-1]["fingers"][1]["w"] == "live"
        assert messages[-1]["fingers"][1]["c"][0] == pytest.approx(2.0, abs=0.06)
        t = messages[-1]["t"]
        past = json.loads(ask(server, f"/api/at?t={messages[5]['end']}")[2])
        assert past["fingers"][0]["w"] == "live"
        found = json.loads(ask(server, f"/api/history?from={t - 1000}&to={t}&bin=20")[2])
        assert len(found["i"]) == len(found["v"]) > 5
        assert all(len(row) == 20 for row in found["v"])
        source.status[1] = CONTACT | 128
        time.sleep(0.15)
        assert first_messages(server, "/events?bin=20", 2)[-1]["fingers"][1]["why"] == "front-end fault"
        source.stopped = True
        time.sleep(0.3)
        assert [f["w"] for f in first_messages(server, "/events?bin=20", 1)[0]["fingers"]] == ["stale", "stale"]


def test_the_buffer_as_csv() -> None:
    source = MovingSource(2)
    with serving(source) as server:
        time.sleep(0.2)
        source.stopped = True
        time.sleep(0.1)
        status, headers, body = ask(server, "/api/buffer.csv")
        assert status == 200
        assert "attachment" in headers["content-disposition"]
        lines = body.decode().splitlines()
        assert lines[0].startswith("t_s,node_id,name,P_N,phi_deg,theta_deg,u_P_N")
        assert len(lines) == 1 + 2 * source.model.counters.rows
        assert lines[2].split(",")[1:6] == ["2", "f2", lines[2].split(",")[3], "-90", "90"]


def test_a_browser_that_does_not_read_holds_up_nobody() -> None:
    source = MovingSource(3)
    with serving(source) as server:
        with socket.create_connection(("127.0.0.1", server.guard.port)) as slow:
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            slow.sendall(f"GET /events?bin=1 HTTP/1.1\r\nHost: 127.0.0.1:{server.guard.port}\r\n\r\n".encode())
            time.sleep(0.5)
            before = source.model.counters.rows
            fast = first_messages(server, "/events?bin=20", 30)
            assert len(fast) == 30
            assert source.model.counters.rows > before + 50
            assert fast[-1]["fingers"][0]["w"] == "live"
        # It left: its thread ends, the page goes on.
        assert ask(server, "/api/setup")[0] == 200


def test_a_pump_that_fails_is_told() -> None:
    source = MovingSource()

    def fail() -> None:
        raise OSError("bus is gone")

    with serving(source) as server:
        source.pump = fail  # type: ignore[method-assign]
        deadline_s = time.monotonic() + 5
        while not source.model.error and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert json.loads(ask(server, "/api/setup")[2])["picture"]["error"] == "OSError: bus is gone"
