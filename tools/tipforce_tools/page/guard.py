"""The flags of the page's server, and its access rules: from headers to a refusal or None.

- Host must name this server: another name that resolves to 127.0.0.1 (DNS rebinding) is refused.
- Origin, if a browser sends it, must be this page: browsers send it with every WebSocket handshake.
- A WebSocket may write if writes are allowed and its handshake had an Origin.
- Beyond loopback every request needs the access token."""

import argparse
import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus

from tipforce.errors import InputError

Refusal = tuple[HTTPStatus, str]
"""The response to a refused request: status and text."""
LOOPBACK_NAMES = ("127.0.0.1", "[::1]", "localhost")
COOKIE = "tipforce_access"
LEAST_TOKEN = 16

CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
SECURITY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
}
"""Headers of every response."""


@dataclass(slots=True)
class Guard:
    """The rules of one server. ``hosts`` are names without port; ``access_token`` is empty on loopback."""

    hosts: tuple[str, ...] = LOOPBACK_NAMES
    access_token: str = ""
    allow_writes: bool = False
    port: int = 0

    def check(self, headers: Mapping[str, str], query_token: str = "") -> Refusal | None:
        """Return None if a request, or a WebSocket handshake, is allowed. ``headers`` ignore case."""
        host = headers.get("Host", "").lower()
        if host not in {f"{name}:{self.port}" for name in self.hosts} | set(self.hosts if self.port == 80 else ()):
            return HTTPStatus.MISDIRECTED_REQUEST, "this server does not have that name"
        origin = headers.get("Origin")
        foreign = origin is not None and origin.lower() != f"http://{host}"
        if foreign or headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            return HTTPStatus.FORBIDDEN, "requests from other pages are refused"
        if self.access_token:
            cookies = dict(part.strip().partition("=")[::2] for part in headers.get("Cookie", "").split(";"))
            given = (token.encode() for token in (query_token, cookies.get(COOKIE, "")))
            if not any(hmac.compare_digest(token, self.access_token.encode()) for token in given):
                return HTTPStatus.UNAUTHORIZED, "open the address with the token that the command printed"
        return None

    def read_only(self, headers: Mapping[str, str]) -> str:
        """Return why a WebSocket with this handshake, which passed ``check``, must not write; empty if it may."""
        if not self.allow_writes:
            return "read-only: start it with --allow-writes"
        return "" if "Origin" in headers else "a page that writes needs an Origin"


def is_loopback(host: str) -> bool:
    """Return whether an address or name is loopback."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def access_token(host: str, token: str | None) -> str:
    """Return the token for ``host``: none on loopback unless given; "auto" generates one. Raises InputError."""
    if token == "auto":
        return secrets.token_urlsafe(24)
    if token is not None:
        if len(token) < LEAST_TOKEN or not (token.isascii() and token.replace("-", "").replace("_", "").isalnum()):
            raise InputError(f"--token: allowed are at least {LEAST_TOKEN} letters, digits, - and _, or auto")
        return token
    if not is_loopback(host):
        raise InputError(
            f"--host {host}: other machines could reach the page; add --token auto (printed at start), or your own"
        )
    return ""


def host_names(host: str) -> tuple[str, ...]:
    """Return the Host names accepted by a server on ``host``."""
    shown = f"[{host}]" if ":" in host else host.lower()
    if host in ("0.0.0.0", "::"):
        raise InputError(
            f"--host {host}: pass the address or host name that browsers will use, so that Host can be checked"
        )
    return tuple(dict.fromkeys((shown, *LOOPBACK_NAMES))) if is_loopback(host) else (shown,)


def page_guard(args: argparse.Namespace) -> Guard:
    """Return the access rules of the page, before anything is opened. Raises InputError."""
    host, may_write = args.host or "127.0.0.1", getattr(args, "allow_writes", False)
    return Guard(access_token=access_token(host, args.token), hosts=host_names(host), allow_writes=may_write)
