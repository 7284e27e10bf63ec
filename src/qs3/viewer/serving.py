"""A viser server for this machine's own user: on the loopback address, behind a secret in its URL.

viser by itself listens on every interface, opens a public tunnel when a page asks for one, and
answers whoever comes: any user of the machine, and any web page that the browser has open.
"""

import contextlib
import dataclasses
import functools
import http
import re
import secrets
import socket
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

from qs3.errors import InputError

LOOPBACK = "127.0.0.1"
_OWN_HOST = re.compile(r"(localhost|127\.0\.0\.1)(:\d{1,5})?", re.ASCII)


def require_viser() -> Any:
    """Import viser.

    Raises:
        InputError: where it is not installed; the message says how to get it.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError(
            "qs3 view needs viser: pip install 'qs3[view]' (in a checkout of qs3: "
            "pip install -e '.[view]')"
        ) from error
    return viser


def require_free(port: int) -> None:
    """Refuse a port that another program has; viser would take the next one without a word.

    Raises:
        InputError: where the port is in use, not allowed or no port.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: must be within 0…65535 (0 takes a free one)")
    try:
        socket.create_server((LOOPBACK, port)).close()
    except OSError as error:
        hint = "name another with --port, or --port 0 for a free one"
        raise InputError(f"--port {port}: {error.strerror}; {hint}") from error


@contextlib.contextmanager
def serve(port: int, title: str) -> Iterator[Any]:
    """Run a `viser.ViserServer` on the loopback address until the block ends.

    Its pages and its socket lie below a random name, which `url_of` tells; all else is forbidden.

    Args:
        port: 0 takes a free one.
        title: Heading of the page's panel.

    Raises:
        InputError: where viser is not installed, the port is in use, or the server cannot be
            guarded.
    """
    viser = require_viser()
    require_free(port)
    import rich
    from websockets.asyncio import server as library

    class Server(viser.ViserServer):
        token = secrets.token_urlsafe(16)

        def request_share_url(self, verbose: bool = True) -> None:
            """Open no tunnel: a page may ask for one, which would show the data to the world."""

    start, guarded = library.serve, []

    def serve_guarded(*where: Any, process_request: Callable[..., Any], **settings: Any) -> Any:
        guarded.append(functools.partial(_check, process_request, Server.token))
        return start(*where, process_request=guarded[-1], **settings)

    with contextlib.ExitStack() as cleanup:
        # viser prints where it listens; standard output is for results.
        console = rich.get_console()
        cleanup.callback(setattr, console, "quiet", console.quiet)
        console.quiet = True
        # viser takes no check of requests; it looks this function up as it starts, only then.
        with mock.patch.object(library, "serve", serve_guarded):
            server = Server(LOOPBACK, port, label=title, verbose=False)
        cleanup.callback(server.stop)
        if not guarded:
            raise InputError("this version of viser cannot be guarded; install viser 1.1")
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        yield server


def _check(answer: Callable[..., Any], token: str, connection: Any, request: Any) -> Any:
    """Answer requests below the token alone, by one of this machine's own names."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    way, _, rest = request.path.removeprefix("/").partition("/")
    way = way.partition("?")[0].encode(errors="replace")
    # A page of another site has that site as its origin, even where its name points at us. Other
    # programs than browsers need not name one.
    if (
        len(hosts) != 1
        or not _OWN_HOST.fullmatch(hosts[0])
        or origins not in ([], [f"http://{hosts[0]}"])
        or not secrets.compare_digest(way, token.encode())
    ):
        return connection.respond(http.HTTPStatus.FORBIDDEN, "not from this page\n")
    return answer(connection, dataclasses.replace(request, path=f"/{rest}"))


def url_of(server: Any) -> str:
    """The address to open in a browser on this machine; who has it, sees the page."""
    return f"http://{LOOPBACK}:{server.get_port()}/{server.token}/"


def tunnel_of(server: Any) -> str:
    """The command that brings the page to another machine, over SSH."""
    port = server.get_port()
    return f"ssh -L {port}:localhost:{port} {socket.gethostname()}"
