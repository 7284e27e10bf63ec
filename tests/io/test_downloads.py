import hashlib
import http.server
import re
import stat
import threading
import zipfile

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.downloads import DATASETS_PAGES, fetch, unpack, where_to_get

CONTENT = np.random.default_rng(0).bytes(300_000)
SUM = hashlib.sha256(CONTENT).hexdigest()


class Server(http.server.ThreadingHTTPServer):
    """Serves CONTENT as its settings say and notes what was asked."""

    daemon_threads = True
    ranges = True
    cut_after: int | None = None
    content = CONTENT
    status = 0
    chunked = False

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.asked = []

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_address[1]}/data.zip"


class Handler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *arguments):
        pass

    def do_GET(self):
        server = self.server
        wanted = self.headers.get("Range")
        server.asked.append(wanted)
        content, begin = server.content, 0
        if server.status:
            self.send_error(server.status)
            return
        if wanted and server.ranges:
            begin = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1])
            if begin >= len(content):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(content)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {begin}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        if not server.chunked:
            self.send_header("Content-Length", str(len(content) - begin))
        self.end_headers()
        self.wfile.write(content[begin : server.cut_after])


@pytest.fixture
def server():
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def test_a_file_is_fetched_checked_and_named(server, tmp_path):
    path = tmp_path / "deep" / "data.zip"
    assert fetch(server.url, path, SUM) == path
    assert path.read_bytes() == CONTENT
    assert [entry.name for entry in path.parent.iterdir()] == ["data.zip"]
    assert server.asked == [None]
    # It is there: nobody is asked again.
    fetch(server.url, path, SUM.upper())
    assert len(server.asked) == 1
    with pytest.raises(InputError, match="is there already and is not"):
        fetch(server.url, path, "0" * 64)
    assert path.read_bytes() == CONTENT


def test_a_cut_connection_is_resumed_where_it_stopped(server, tmp_path):
    path = tmp_path / "data.zip"
    server.cut_after = 100_000
    with pytest.raises(InputError, match="cut after 100000 of 300000 bytes; run the same command"):
        fetch(server.url, path, SUM)
    assert not path.exists()
    assert (tmp_path / "data.zip.part").stat().st_size == 100_000
    server.cut_after = None
    fetch(server.url, path, SUM)
    assert server.asked == [None, "bytes=100000-"]
    assert path.read_bytes() == CONTENT
    assert not (tmp_path / "data.zip.part").exists()


def test_a_server_without_ranges_begins_anew(server, tmp_path):
    (tmp_path / "data.zip.part").write_bytes(CONTENT[:50_000])
    server.ranges = False
    fetch(server.url, tmp_path / "data.zip", SUM)
    assert server.asked == ["bytes=50000-"]
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


def test_a_part_of_another_file_is_thrown_away(server, tmp_path):
    (tmp_path / "data.zip.part").write_bytes(b"x" * 50_000)
    fetch(server.url, tmp_path / "data.zip", SUM)
    assert server.asked == ["bytes=50000-", None]
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


@pytest.mark.parametrize(("part", "asked"), [(CONTENT, 1), (CONTENT + b"more", 2)])
def test_a_part_that_is_whole_or_longer_already(server, tmp_path, part, asked):
    (tmp_path / "data.zip.part").write_bytes(part)
    fetch(server.url, tmp_path / "data.zip", SUM)
    assert len(server.asked) == asked
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


def test_another_checksum_is_refused_and_nothing_kept(server, tmp_path):
    server.content = CONTENT[:-1] + b"!"
    with pytest.raises(InputError, match=f"not {SUM}; the file there is another one"):
        fetch(server.url, tmp_path / "data.zip", SUM)
    assert list(tmp_path.iterdir()) == []


def test_a_length_that_is_not_announced_is_caught_by_the_checksum(server, tmp_path):
    server.chunked = True
    fetch(server.url, tmp_path / "a.zip", SUM)
    server.cut_after = 1000
    with pytest.raises(InputError, match="has the SHA-256"):
        fetch(server.url, tmp_path / "b.zip", SUM)
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]


@pytest.mark.parametrize("code", [404, 403, 500])
def test_a_refusal_of_the_server_is_told(server, tmp_path, code):
    server.status = code
    with pytest.raises(InputError, match=rf"data\.zip: the server answers {code} ") as caught:
        fetch(server.url, tmp_path / "data.zip", SUM)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_no_network_is_told(tmp_path):
    with Server() as closed:
        url = closed.url
    with pytest.raises(InputError, match="cannot be reached, or the connection was cut") as caught:
        fetch(url, tmp_path / "data.zip", SUM)
    assert url in str(caught.value)
    with pytest.raises(InputError, match="cannot be reached"):
        fetch("http://no.such.host.invalid/a.zip", tmp_path / "data.zip", SUM)


def test_a_silent_server_is_left(tmp_path):
    import socket

    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/a.zip"
        with pytest.raises(InputError, match="timed out"):
            fetch(url, tmp_path / "data.zip", SUM, timeout=0.2)


def test_a_full_disk_is_told(server, tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("qs3.io.downloads._copy", full)
    with pytest.raises(InputError, match=r"data\.zip\.part: No space left on device"):
        fetch(server.url, tmp_path / "data.zip", SUM)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://a/b", "/etc/passwd", ""])
def test_only_http_is_fetched(tmp_path, url):
    with pytest.raises(InputError, match="not an http or https address"):
        fetch(url, tmp_path / "a", SUM)
    with pytest.raises(InputError, match="not a SHA-256"):
        fetch("http://127.0.0.1/a", tmp_path / "a", "md5")


def archive(path, members):
    """Write a zip of (name or ZipInfo, bytes)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in members:
            opened.writestr(name, content)
    return path


def linked(name, target):
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info, target


GOOD = ("chair/a.xyz", b"1 2 3\n")


def test_an_archive_is_unpacked_whole(tmp_path):
    path = archive(
        tmp_path / "a.zip",
        [GOOD, ("chair/", b""), ("empty/", b""), ("b..c.txt", b"x"), ("zero", b"")],
    )
    assert unpack(path, tmp_path / "out") == tmp_path / "out"
    found = {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*")}
    assert found == {"chair", "chair/a.xyz", "empty", "b..c.txt", "zero"}
    assert (tmp_path / "out" / "chair" / "a.xyz").read_bytes() == b"1 2 3\n"
    with pytest.raises(InputError, match="is there already"):
        unpack(path, tmp_path / "out")


EVIL = {
    "up": [("../evil", b"x")],
    "up within": [("a/../../evil", b"x")],
    "absolute": [("/var/evil", b"x")],
    "backslash": [("..\\evil", b"x")],
    "drive": [("C:/evil", b"x")],
    "drive backslash": [("c:evil", b"x")],
    "share": [("\\\\host\\evil", b"x")],
    "link": [linked("evil", "/etc/passwd")],
    "link then file": [linked("sub", "/var"), ("sub/evil", b"x")],
    "twice": [("a", b"x"), ("A", b"y")],
    "file and folder": [("a", b"x"), ("a/b", b"y")],
    "device": [(lambda i: (setattr(i, "external_attr", stat.S_IFCHR << 16), i)[1])(
        zipfile.ZipInfo("dev")), b""],
}  # fmt: skip
EVIL["device"] = [tuple(EVIL["device"])]


@pytest.mark.parametrize("case", EVIL)
@pytest.mark.parametrize("last", [False, True])
def test_one_bad_member_spoils_the_archive_and_nothing_is_written(tmp_path, case, last):
    members = [GOOD, *EVIL[case]] if last else [*EVIL[case], GOOD]
    path = archive(tmp_path / "a.zip", members)
    with pytest.raises(InputError, match=r"a\.zip: ") as caught:
        unpack(path, tmp_path / "inner" / "out")
    assert "\n" not in str(caught.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.zip"]


def test_a_name_with_a_nul_is_refused(tmp_path):
    path = archive(tmp_path / "a.zip", [("evilX.txt", b"x")])
    path.write_bytes(path.read_bytes().replace(b"evilX.txt", b"evil\0.txt"))
    with pytest.raises(InputError, match="would lead outside"):
        unpack(path, tmp_path / "out")


def test_bombs_are_refused_by_what_they_announce(tmp_path):
    path = archive(tmp_path / "a.zip", [(f"{i}.npy", bytes(30 * 2**20)) for i in range(5)])
    assert path.stat().st_size < 2**20
    with pytest.raises(InputError, match="as no honest data set does"):
        unpack(path, tmp_path / "out")
    with pytest.raises(InputError, match="would grow to 157286400 bytes, over the 1000 allowed"):
        unpack(path, tmp_path / "out", max_bytes=1000)
    assert not (tmp_path / "out").exists()


def test_a_member_that_grows_beyond_what_it_announces_is_refused(tmp_path):
    path = archive(tmp_path / "a.zip", [("a.npy", bytes(2**20))])
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    for place in (22, directory + 24):
        assert int.from_bytes(content[place : place + 4], "little") == 2**20
        content[place : place + 4] = (10).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a zip archive, or damaged"):
        unpack(path, tmp_path / "out")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.zip"]


def test_damaged_archives_are_one_line(tmp_path, rng):
    with pytest.raises(InputError, match="no such file"):
        unpack(tmp_path / "none.zip", tmp_path / "out")
    good = archive(tmp_path / "a.zip", [(f"{i}/a.xyz", rng.bytes(50)) for i in range(5)])
    content = good.read_bytes()
    refused = 0
    for number in range(120):
        data = bytearray(content)
        for _ in range(rng.integers(1, 4)):
            data[int(rng.integers(len(data)))] = rng.integers(256)
        if number % 10 == 0:
            data = data[: int(rng.integers(len(data)))]
        good.write_bytes(data)
        try:
            unpack(good, tmp_path / "work" / str(number))
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
            assert str(good) in str(error)
            assert not (tmp_path / "work" / str(number)).exists()
    assert refused > 40
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "work"]


def test_every_data_set_of_the_field_has_a_page_and_a_layout():
    for name in ("ModelNet40", "modelnet10", "ShapeNet", "scannet", "SUNRGBD", "pointda10-scannet",
                 "specklenet10", "depthscannet10", "scanobjectnn-hardest", "graspnetpc10-synthetic",
                 "modelnet40_h5"):  # fmt: skip
        told = where_to_get(name)
        assert re.match(r"get it from https?://\S+", told)
        assert "expected: " in told
        assert "\n" not in told
    assert "ModelNet10.zip" in where_to_get("modelnet10")
    assert "ModelNet40.zip" in where_to_get("modelnet40")
    assert where_to_get("ply") == where_to_get("") == ""
    assert len(DATASETS_PAGES) >= 10
