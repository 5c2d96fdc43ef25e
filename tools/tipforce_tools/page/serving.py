"""The page's server with its flags, for `tipforce view` and `demo --view`."""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING

from tipforce.errors import InputError
from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce_tools.page.guard import Guard
    from tipforce_tools.page.sources import Source

DEFAULT_PORT = 8404


def add_page_arguments(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Add the flags of the page's server; return their group."""
    group = parser.add_argument_group("page")
    port, host = "default %(default)s; 0: any free port", "address to serve on, default loopback; others need --token"
    group.add_argument("--port", type=int, default=DEFAULT_PORT, metavar="N", help=port)
    group.add_argument("--host", default="", metavar="ADDRESS", help=host)
    group.add_argument("--token", metavar="TOKEN|auto", help="required to open the page; auto generates one")
    group.add_argument("--open", action="store_true", help="open the page in the browser")
    return group


def page_guard(args: argparse.Namespace) -> Guard:
    """Return the access rules of the page, before anything is opened. Raises InputError."""
    from tipforce_tools.page.guard import Guard, access_token, host_names

    if not 0 <= args.port <= 65535:
        raise InputError(f"--port {args.port}: allowed are 0 (any free port) to 65535")
    host, may_write = args.host or "127.0.0.1", getattr(args, "allow_writes", False)
    return Guard(access_token=access_token(host, args.token), hosts=host_names(host), allow_writes=may_write)


def serve(args: argparse.Namespace, source: Source, guard: Guard) -> int:
    """Serve the page of a source until Ctrl-C or SIGTERM."""
    from tipforce_tools.cli.main import terminate_as_interrupt
    from tipforce_tools.page.server import ViewServer

    server = ViewServer(source, guard, (args.host,) if args.host else ("127.0.0.1", "::1"), args.port)
    terminate_as_interrupt()
    server.start()
    try:
        common.print_record({"url": server.url}, server.url)
        sys.stdout.flush()
        access = "read and tare" if guard.allow_writes and not source.no_tare else "read-only"
        common.note(f"{source.title}: {access}; Ctrl-C ends it")
        if args.open:
            import webbrowser

            webbrowser.open(server.url)
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return 0
    finally:
        server.close()
