"""Who may ask for what."""

from __future__ import annotations

from http import HTTPStatus

import pytest

from tipforce.errors import InputError
from tipforce_tools.view.guard import Guard, access_token, host_names

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


def test_writing_needs_permission_and_an_origin() -> None:
    guard = Guard(port=8404, allow_writes=True)
    assert guard.read_only(ORIGIN) == ""
    assert guard.read_only(HOST) == "a page that writes needs an Origin"
    assert Guard(port=8404).read_only(ORIGIN) == "read-only: start it with --allow-writes"


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
