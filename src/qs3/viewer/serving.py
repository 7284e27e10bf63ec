"""A viser server on this machine's own address, which no other machine can reach."""

import contextlib
import socket
from collections.abc import Iterator
from typing import Any

from qs3.errors import InputError

LOOPBACK = "127.0.0.1"


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

    Args:
        port: 0 takes a free one.
        title: Heading of the page's panel.

    Raises:
        InputError: where viser is not installed.
    """
    viser = require_viser()
    import rich

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Open no tunnel: a page may ask for one, which would show the data to the world."""

    with contextlib.ExitStack() as cleanup:
        # viser prints where it listens; standard output is for results.
        console = rich.get_console()
        cleanup.callback(setattr, console, "quiet", console.quiet)
        console.quiet = True
        server = Server(LOOPBACK, port, label=title, verbose=False)
        cleanup.callback(server.stop)
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        yield server


def url_of(server: Any) -> str:
    """The address to open in a browser on this machine."""
    return f"http://{LOOPBACK}:{server.get_port()}"


def tunnel_of(server: Any) -> str:
    """The command that brings the page to another machine, over SSH."""
    port = server.get_port()
    return f"ssh -L {port}:localhost:{port} {socket.gethostname()}"
