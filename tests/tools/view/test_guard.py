"""Who may ask for what."""

from __future__ import annotations

from http import HTTPStatus

import pytest

from tipforce.errors import InputError
from tipforce_tools.view.guard import WRITE_HEADER, Guard, access_token, host_names

HOST = {"Host": "127.0.0.1:8404"}
ORIGIN = HOST | {"Origin": "http://127.0.0.1:8404"}


def status(guard: Guard, method: str, headers: dict[str, str], token: str = "") -> int:
    refusal = guard.check(method, headers, token)
    return HTTPStatus.OK if refusal is None else refusal.status


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
    assert status(Guard(port=8404), "GET", headers) == expected


def test_writing_needs_everything() -> None:
    guard = Guard(port=8404, allow_writes=True)
    whole = ORIGIN | {WRITE_HEADER: guard.write_token}
    assert status(guard, "POST", whole) == 200
    assert status(Guard(port=8404, write_token=guard.write_token), "POST", whole) == 403
    for name in ("Origin", WRITE_HEADER):
        assert status(guard, "POST", {k: v for k, v in whole.items() if k != name}) == 403
    assert status(guard, "POST", whole | {WRITE_HEADER: "x" + guard.write_token}) == 403
    assert status(guard, "POST", whole | {WRITE_HEADER: ""}) == 403


def test_beyond_loopback_everybody_needs_the_token() -> None:
    token = access_token("192.0.2.1", "auto")
    guard = Guard(host_names("192.0.2.1"), token, port=8404)
    host = {"Host": "192.0.2.1:8404"}
    assert status(guard, "GET", host) == 401
    assert status(guard, "GET", host, token) == 200
    assert status(guard, "GET", host, token[:-1]) == 401
    assert status(guard, "GET", host | {"Cookie": f"a=b; tipforce_access={token}"}) == 200
    assert status(guard, "GET", host | {"Cookie": "tipforce_access="}) == 401
    assert status(guard, "GET", {"Host": "127.0.0.1:8404"}, token) == 421


def test_tokens() -> None:
    assert access_token("127.0.0.1", None) == access_token("::1", None) == access_token("localhost", None) == ""
    for host, token in (
        ("192.0.2.1", None),
        ("192.0.2.1", "short"),
        ("192.0.2.1", "a" * 15 + "\n"),
        ("hand.local", None),
    ):
        with pytest.raises(InputError):
            access_token(host, token)
    with pytest.raises(InputError):
        host_names("0.0.0.0")
