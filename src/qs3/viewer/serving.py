"""A viser server that only those it is meant for can reach.

viser by itself listens on every interface, takes the next port where one is in use, opens a public
tunnel when a page asks for one, and answers web sockets of any page that the browser has open. Here
it gets one bound socket, no tunnel, and a check of where a request comes from. Over HTTP viser
hands out its own page and nothing else.
"""

import contextlib
import errno
import http
import ipaddress
import re
import socket
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

from qs3.errors import InputError

LOOPBACK = "127.0.0.1"
# All that the page needs is in it: with this policy the browser asks nobody else for anything.
# viser unpacks itself with inline scripts, WebAssembly and workers. Not every browser takes 'self'
# for the page's own web socket.
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' data: blob: "
    "ws://{host}; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's own, which no other machine can reach.

    Example:
        >>> is_loopback("127.0.0.1"), is_loopback("0.0.0.0")
        (True, False)
    """
    return all(ipaddress.ip_address(address).is_loopback for _, address in _addresses(host))


def bind(host: str, port: int) -> socket.socket:
    """Take a port of an address; 0 takes a free one.

    Raises:
        InputError: where the port is in use or no port, or the address is not this machine's.
    """
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: must be within 0…65535 (0 takes a free one)")
    family, address = _addresses(host)[0]
    try:
        return socket.create_server((address, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            hint = "in use; name another with --port, or --port 0 for a free one"
        elif error.errno == errno.EADDRNOTAVAIL:
            raise InputError(f"--host {host}: is no address of this machine") from error
        else:
            hint = error.strerror or str(error)
        raise InputError(f"--port {port} on {host}: {hint}") from error


def url_of(listener: socket.socket) -> str:
    """The address to open in a browser."""
    host, port = listener.getsockname()[:2]
    if ipaddress.ip_address(host).is_unspecified:
        host = "localhost"
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def own_names(host: str) -> frozenset[str]:
    """Names by which other machines may ask for the page: this machine's own and the one given."""
    names = {"localhost", host, socket.gethostname(), socket.getfqdn()}
    return frozenset(name.lower() for name in names if name)


def allowed(host: str | None, origin: str | None, names: frozenset[str] | None) -> bool:
    """Whether a request comes from our own page.

    A page of another site that the same browser shows must not read the data: its web socket has
    the other site as its origin. Nor must one that has let its own name point at this machine: then
    host and origin agree, but are no name of this machine.

    Args:
        host: The request's ``Host``.
        origin: Its ``Origin``; browsers send it with every web socket, other programs need not.
        names: Names that other machines may ask by, from `own_names`, besides any address in
            numbers; None where the server listens on the loopback address alone.

    Example:
        >>> allowed("localhost:8080", "http://localhost:8080", None)
        True
        >>> allowed("localhost:8080", "https://example.org", None)
        False
    """
    if host is None or (origin is not None and urlsplit(origin).netloc != host):
        return False
    return _is_own(urlsplit(f"//{host}").hostname or "", names)


@contextlib.contextmanager
def serve(listener: socket.socket, title: str, host: str = "") -> Iterator[Any]:
    """Run a `viser.ViserServer` on a bound socket until the block ends.

    Args:
        listener: From `bind`; closed at the end.
        title: Heading of the page's panel.
        host: Name that the user gave for the address; requests by that name are answered too.

    Raises:
        InputError: where viser is not installed.
    """
    with contextlib.closing(listener), contextlib.ExitStack() as cleanup:
        server = _start(listener, title, host, cleanup)
        yield server


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


def _start(listener: socket.socket, title: str, host: str, cleanup: contextlib.ExitStack) -> Any:
    viser = require_viser()
    import rich
    import websockets.asyncio.server as library

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Open no tunnel: a page may ask for one, which would show the data to the world."""

    # viser prints where it listens; standard output is for results.
    console = rich.get_console()
    cleanup.callback(setattr, console, "quiet", console.quiet)
    console.quiet = True

    address = str(listener.getsockname()[0])
    names = None if is_loopback(address) else own_names(host)
    original, used = library.serve, []

    def guarded(handler: Any, host: Any, port: Any, **settings: Any) -> Any:
        used.append(True)
        settings["process_request"] = _checked(settings["process_request"], names)
        return original(handler, sock=listener, process_response=_with_policy, **settings)

    # NOTE: viser has no way to hand it a socket or a check; it looks this function up when it
    # starts, and only then.
    library.serve = guarded
    try:
        server = Server(*listener.getsockname()[:2], label=title, verbose=False)
    finally:
        library.serve = original
    cleanup.callback(server.stop)
    if not used:
        raise InputError("this version of viser is not known to be safe; install viser 1.1")
    server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    return server


def _checked(answer: Callable[..., Any], names: frozenset[str] | None) -> Callable[..., Any]:
    def check(connection: Any, request: Any) -> Any:
        # A header that is given twice is a request to refuse.
        given = {name: request.headers.get_all(name) for name in ("Host", "Origin")}
        host, origin = (values[0] if len(values) == 1 else None for values in given.values())
        doubled = any(len(values) > 1 for values in given.values())
        if doubled or not allowed(host, origin, names):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "not from this page\n")
        return answer(connection, request)

    return check


def _with_policy(connection: Any, request: Any, response: Any) -> None:
    host = request.headers.get("Host", "")
    host = host if re.fullmatch(r"[\w.:\[\]-]+", host, re.ASCII) else "localhost"
    response.headers["Content-Security-Policy"] = _POLICY.format(host=host)
    response.headers["X-Content-Type-Options"] = "nosniff"


def _addresses(host: str) -> list[tuple[socket.AddressFamily, str]]:
    try:
        found = socket.getaddrinfo(host or None, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise InputError(f"--host {host}: is no address of this machine") from error
    return [(family, str(address[0])) for family, _, _, _, address in found]


def _is_own(name: str, names: frozenset[str] | None) -> bool:
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return name in ({"localhost"} if names is None else names)
    # No other site can pass itself off as an address of numbers.
    return names is not None or address.is_loopback
