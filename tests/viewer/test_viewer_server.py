"""The viewer's pages and its server: what the controls do, and that nobody else gets in."""

import contextlib
import http.client
import socket
import threading
import urllib.request

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.settings import ScanSettings
from qs3.viewer.exhibits import Answers, ArrayExhibits, Exhibit
from qs3.viewer.pages import gallery_page, scan_page
from qs3.viewer.scan_controls import resolve
from qs3.viewer.serving import require_free, serve, tunnel_of, url_of

from ..browser import until

viser = pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")


@pytest.fixture(scope="module")
def server():
    with serve(0, "test") as server:
        yield server


def answer(server, path="", headers=(), token=None):
    """Status and body of a request below the token, or another; headers may come twice."""
    token = server.token if token is None else token
    host = [("Host", f"localhost:{server.get_port()}")]
    given = headers if any(name == "Host" for name, _ in headers) else [*host, *headers]
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.putrequest("GET", f"/{token}/{path}", skip_host=True)
    for header in given:
        connection.putheader(*header)
    connection.endheaders()
    with contextlib.closing(connection), connection.getresponse() as got:
        return got.status, got.read()


UPGRADE = [
    ("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Key", "AAAAAAAAAAAAAAAAAAAAAA=="),
]  # fmt: skip


def test_hands_out_its_page_and_says_how_to_reach_it_from_elsewhere(server):
    with urllib.request.urlopen(url_of(server), timeout=10) as got:  # noqa: S310
        assert b"viser" in got.read().lower()
    port = server.get_port()
    assert tunnel_of(server) == f"ssh -L {port}:localhost:{port} {socket.gethostname()}"


@pytest.mark.parametrize("upgrade", [[], UPGRADE], ids=["page", "socket"])
def test_forbids_who_has_no_token_and_who_comes_from_elsewhere(server, upgrade):
    good, own = 101 if upgrade else 200, f"localhost:{server.get_port()}"
    assert answer(server, headers=upgrade)[0] == good
    assert answer(server, headers=[*upgrade, ("Origin", f"http://{own}")])[0] == good
    tunnelled = [("Host", "127.0.0.1:9"), ("Origin", "http://127.0.0.1:9")]
    assert answer(server, headers=[*upgrade, *tunnelled])[0] == good
    for token in ("", "x" * len(server.token), server.token[:-1], "%ff", server.token.upper()):
        assert answer(server, headers=upgrade, token=token)[0] == 403
    for host in ("example.org", "localhost.example.org", f"{own}.example.org", "192.168.1.2:80"):
        assert answer(server, headers=[*upgrade, ("Host", host)])[0] == 403
    assert answer(server, headers=[*upgrade, ("Host", own), ("Host", own)])[0] == 403
    for origin in ("http://example.org", f"https://{own}", "http://localhost:1", "null"):
        assert answer(server, headers=[*upgrade, ("Origin", origin)])[0] == 403


@pytest.mark.parametrize(
    "path",
    ["../viser/__init__.py", "%2e%2e/%2e%2e/__init__.py", "/etc/passwd", "..%5c__init__.py",
     "index.html/../../../__init__.py", "__init__.py", "etc/passwd"],
)  # fmt: skip
def test_reads_no_file_of_the_disk(server, path):
    status, body = answer(server, path)
    assert status == 404
    assert body in (b"", b"NOT FOUND")


def test_is_not_there_on_another_interface(server):
    """Nor on another loopback address: it does not listen on all."""
    addresses = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    others = {str(address[4][0]) for address in addresses} - {"127.0.0.1"}
    for address in {"127.0.0.2", *others}:
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((address, server.get_port()), timeout=5)
    socket.create_connection(("127.0.0.1", server.get_port()), timeout=5).close()


def test_opens_no_tunnel(server, monkeypatch):
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_: pytest.fail("a tunnel"))
    assert server.request_share_url() is None


def test_a_port_that_cannot_be_had_is_named(server):
    port = server.get_port()
    with pytest.raises(InputError, match=f"--port {port}: Address already in use"):
        require_free(port)
    for wrong in (70000, -1):
        with pytest.raises(InputError, match=f"--port {wrong}"):
            require_free(wrong)


def test_the_port_is_free_again_and_nothing_was_printed(capfd):
    with serve(0, "test") as server:
        port = server.get_port()
    require_free(port)
    assert capfd.readouterr().out == ""


def controls(server):
    return {h.label: h for h in server.gui._gui_input_handle_from_uuid.values()}


def test_scan_page_shows_faults_and_recovers(server, rng):
    """The scan page with a scan that fails, then works; a slider asks for the next."""
    calls = threading.Semaphore(0)
    item = Exhibit("a", "chair", {"points": rng.normal(size=(9, 3)).astype(np.float32)})

    def scan(settings, draw):
        calls.release()
        if settings.views == 5:
            raise InputError("too many views")
        return item

    start = resolve(ScanSettings(renderer=MitsubaRenderer(variant="scalar_rgb")))
    with scan_page(server, scan, start, 3) as canvas:
        assert calls.acquire(timeout=10)
        until(lambda: "too many views" in canvas._state.content)
        controls(server)["Views"].value = 2
        assert calls.acquire(timeout=10)
        until(lambda: "chair" in canvas._text.content)
        assert canvas._state.content == ""
        controls(server)["Sensor"].value = "d435"
        assert calls.acquire(timeout=10)
        now = {name: handle.value for name, handle in controls(server).items()}
        assert now["Distance (m)"] == (1.2, 2.0)
        assert now["Views"] == 2
    server.gui.reset()


def test_gallery_steps_and_filters(server, rng):
    points = rng.normal(size=(4, 6, 3)).astype(np.float32)
    items = ArrayExhibits(points, ("a0", "b0", "a1", "b1"), ("a", "b", "a", "b"))
    answers = Answers(np.array([[1.0, 0]] * 4), ("a", "b"), np.array([0, 1, 0, 1]))
    with gallery_page(server, items, answers, "b") as canvas:
        handles = controls(server)
        until(lambda: "b0" in canvas._text.content)
        assert handles["Object"].max == 2
        handles["Object"].value = 2
        until(lambda: "b1" in canvas._text.content)
        handles["Wrong ones only"].value = True
        until(lambda: "b0" in canvas._text.content)
        handles["Class"].value = "a"
        until(lambda: "none of this class is wrong" in canvas._state.content)
    server.gui.reset()
    with pytest.raises(InputError, match="--class-name c: no object of it; classes here: a, b"):
        gallery_page(server, items, None, "c").__enter__()
    server.gui.reset()


def test_wrong_answers_are_counted_once_and_not_for_each_object(server, monkeypatch):
    counted, wrong = [], Answers.wrong.fget
    monkeypatch.setattr(Answers, "wrong", property(lambda own: counted.append(1) or wrong(own)))
    items = ArrayExhibits(np.zeros((50, 6, 3)), ("a",) * 50, ("a",) * 50)
    answers = Answers(np.array([[1.0, 0]] * 50), ("a", "b"), np.arange(50) % 2)
    with gallery_page(server, items, answers):
        controls(server)["Wrong ones only"].value = True
        until(lambda: controls(server)["Object"].max == 25)
    assert len(counted) < 25
    server.gui.reset()
