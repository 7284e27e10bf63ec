"""The viewer: what is shown is right, the last change wins, and nobody else gets in."""

import socket
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.report.figure import PALETTE
from qs3.sensor.presets import SENSORS, Sensor
from qs3.store.manifest import Manifest, write_manifest
from qs3.store.shards import CloudRow, write_shard
from qs3.viewer import (
    Answers,
    ArrayExhibits,
    Exhibit,
    Rescanner,
    ScanControls,
    StoreExhibits,
    bind,
    gallery_page,
    is_loopback,
    scan_page,
    serve,
)
from qs3.viewer.colouring import by_error, by_height, by_view, round_limit
from qs3.viewer.display import compose, frame_of, modes
from qs3.viewer.distance import cloud_distance, mesh_distance, spacing
from qs3.viewer.serving import allowed, own_names

HOSTILE = "<img src=x onerror=alert(1)>{alert(2)}"


def exhibit(rng, **given) -> Exhibit:
    clean = rng.normal(size=(40, 3)).astype(np.float32)
    clouds = {"points": clean + np.float32([0, 0, 0.25]), "clean": clean}
    views = {"points": np.repeat(np.arange(4, dtype=np.uint8), 10)}
    return Exhibit("a", "chair", clouds, views, **given)


class TestDistance:
    def test_to_a_ball_is_that_to_its_surface(self, rng):
        ball = trimesh.creation.icosphere(subdivisions=5)
        points = rng.normal(size=(200, 3))
        expected = np.abs(np.linalg.norm(points, axis=1) - 1)
        np.testing.assert_allclose(mesh_distance(points, ball), expected, atol=1.5e-3)

    def test_agrees_with_an_independent_reference(self, rng):
        """Triangles of very different sizes, some of them without area."""
        mesh = shapes.make("chair", seed=3)
        vertices = np.concatenate([mesh.vertices, [[-9, -9, 0], [9, -9, 0], [0, 9, 0]]])
        count = len(mesh.vertices)
        faces = np.concatenate([mesh.faces, [[count, count + 1, count + 2], [0, 0, 1]]])
        mixed = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
        points = rng.uniform(-1, 1.5, size=(60, 3))
        every = np.asarray(mixed.vertices)[faces]
        expected = [
            np.linalg.norm(
                trimesh.triangles.closest_point(every, np.tile(p, (len(every), 1))) - p, axis=1
            ).min()
            for p in points
        ]
        np.testing.assert_allclose(mesh_distance(points, mixed), expected, atol=1e-9)

    def test_does_not_depend_on_how_much_is_measured_at_once(self, rng, monkeypatch):
        mesh, points = shapes.make("lamp", seed=1), rng.normal(size=(50, 3))
        whole = mesh_distance(points, mesh)
        monkeypatch.setattr("qs3.viewer.distance._PAIRS", 7)
        np.testing.assert_array_equal(mesh_distance(points, mesh), whole)

    def test_surface_points_have_none(self, rng):
        mesh = shapes.make("sofa", seed=0)
        on = np.asarray(mesh.triangles_center)[rng.integers(0, len(mesh.faces), 100)]
        assert mesh_distance(on, mesh).max() < 1e-9

    def test_of_clouds(self, rng):
        cloud = rng.normal(size=(30, 3))
        assert cloud_distance(cloud, cloud).max() == 0
        far = cloud_distance(cloud + np.array([100.0, 0, 0]), cloud)
        assert (np.abs(far - 100) < 10).all()
        assert spacing(cloud[:1]) == 0


class TestColours:
    def test_views_have_the_palette_and_the_legend_counts_them(self):
        view = np.array([0, 0, 11], dtype=np.uint8)
        found = by_view(view)
        expected = [tuple(int(PALETTE[i][k : k + 2], 16) for k in (1, 3, 5)) for i in (0, 0, 1)]
        assert [tuple(c) for c in found.colours.tolist()] == expected
        assert found.swatches == (
            (PALETTE[0], "view 1 (2 points)"),
            (PALETTE[1], "view 12 (1 point)"),
        )

    def test_errors_share_a_scale_and_stop_at_its_end(self):
        found = by_error(np.array([0.0, 0.5, 1.0, 9.0]), "the mesh", 1.0, " m")
        low, middle, high, beyond = found.colours.tolist()
        assert high == beyond != middle != low
        assert found.ends == ("0 m", "1 m and more")
        assert low == [68, 1, 84]  # viridis begins dark violet

    def test_height_of_a_flat_cloud_is_one_colour(self):
        assert len(np.unique(by_height(np.ones((5, 3))).colours, axis=0)) == 1

    @pytest.mark.parametrize("scale", [1e-6, 0.003, 1.0, 400.0])
    def test_limit_is_round_and_holds_95_percent(self, rng, scale):
        distance = scale * rng.random(1000)
        limit = round_limit(distance)
        assert np.mean(distance <= limit) >= 0.95
        assert f"{limit:.0e}"[0] in "125"
        assert limit == float(f"{limit:.0e}")
        assert limit < 2.5 * np.percentile(distance, 95)

    def test_limit_of_no_error_is_usable(self):
        assert round_limit(np.zeros(4)) == 1.0


class TestDisplay:
    def test_error_is_to_the_clean_twin(self, rng):
        shown = compose(exhibit(rng), "points", "error")
        assert shown.colouring.title == "distance to the clean twin"
        assert "median" in dict(shown.facts)["error"]
        assert "spacing of the clean twin" in dict(shown.facts)

    def test_error_is_to_the_mesh_where_there_is_one(self, rng):
        box = trimesh.creation.box((2, 2, 2))
        item = Exhibit(
            "a", "", {"points": np.float32([[0, 0, 1.5], [0, 0, 1.5]])}, {}, box, (), " m"
        )
        shown = compose(item, "points", "error")
        assert shown.colouring.title == "distance to the mesh"
        assert dict(shown.facts)["error"].startswith("median 0.5 m")
        assert compose(item, "points", "error", limit=0.75).colouring.ends == (
            "0 m",
            "0.75 m and more",
        )

    @pytest.mark.parametrize("mode", ["error", "view", "predicted class", "right or wrong"])
    def test_what_is_not_known_is_grey_and_says_so(self, rng, mode):
        bare = Exhibit("a", "", {"surface": rng.normal(size=(9, 3))})
        shown = compose(bare, "surface", mode)
        assert len(np.unique(shown.colouring.colours, axis=0)) == 1
        assert "not known" in shown.colouring.legend()

    def test_a_kind_that_is_not_there_gives_one_that_is(self, rng):
        item = exhibit(rng)
        np.testing.assert_array_equal(
            compose(item, "surface", "height").points, item.clouds["points"]
        )

    def test_answers_are_told_and_coloured(self, rng):
        shares = np.array([[0.9, 0.1], [0.2, 0.8]])
        answers = Answers(shares, ("bed", "chair"), np.array([1, 1]))
        assert answers.wrong.tolist() == [True, False]
        wrong, right = (
            compose(exhibit(rng), "points", "right or wrong", answers, row) for row in (0, 1)
        )
        assert (wrong.colouring.colours[0] != right.colouring.colours[0]).any()
        assert dict(wrong.facts)["this is"] == "wrong"
        assert dict(wrong.facts)["network, of the noisy cloud"] == "bed 90.0%, chair 10.0%"
        shown = compose(exhibit(rng), "points", "predicted class", answers, 1)
        assert shown.colouring.swatches == ((PALETTE[1], "chair"),)

    def test_without_labels_nothing_is_right_or_wrong(self):
        answers = Answers(np.array([[1.0, 0.0]]), ("bed", "chair"), None)
        assert not answers.wrong.any()
        assert "right or wrong" not in modes(answers)

    def test_names_are_escaped(self, rng):
        item = Exhibit(
            HOSTILE, HOSTILE, {"points": rng.normal(size=(4, 3))}, facts=((HOSTILE,) * 2,)
        )
        answers = Answers(np.ones((1, 1)), (HOSTILE,), None)
        shown = compose(item, "points", "predicted class", answers)
        assert "<img" not in shown.text() + shown.colouring.legend()
        assert "&lt;img" in shown.text()

    def test_every_object_is_drawn_one_unit_long(self, rng):
        points = 40 * rng.random((50, 3)) + 1000
        middle, side = frame_of(Exhibit("a", "", {"points": points}))
        drawn = (points - middle) / side
        assert np.ptp(drawn, axis=0).max() == pytest.approx(1)
        np.testing.assert_allclose(drawn.min(axis=0) + drawn.max(axis=0), 0, atol=1e-9)
        assert frame_of(Exhibit("a", "", {"points": np.ones((3, 3))}))[1] == 1.0


class TestRescanner:
    def test_the_last_change_wins(self):
        """What is overtaken, waiting or under way, is never shown."""
        begun, go, shown, last = threading.Event(), threading.Event(), [], threading.Event()

        def work(value):
            begun.set()
            assert go.wait(10)
            return value

        def show(outcome):
            shown.append(outcome.result)
            last.set()

        worker = Rescanner(work, show, delay=0.0)
        worker.ask(1)
        assert begun.wait(10)
        worker.ask(2)
        worker.ask(3)
        go.set()
        assert last.wait(10)
        assert worker.close(10.0)
        assert shown == [3]

    def test_waits_until_changes_rest(self):
        worked, done = [], threading.Event()
        worker = Rescanner(worked.append, lambda _: done.set(), delay=0.3)
        for value in range(5):
            worker.ask(value)
        assert done.wait(10)
        worker.close(10.0)
        assert worked == [4]

    def test_faults_are_shown_and_the_worker_lives_on(self, caplog):
        outcomes, more = [], threading.Semaphore(0)

        def work(value):
            if value == 0:
                raise InputError("no such thing")
            return value

        def show(outcome):
            outcomes.append(outcome)
            more.release()
            if outcome.result == 1:
                raise RuntimeError("the page broke")

        worker = Rescanner(work, show, delay=0.0)
        for value in (0, 1, 2):
            worker.ask(value)
            assert more.acquire(timeout=10)
        worker.close(10.0)
        assert str(outcomes[0].error) == "no such thing"
        assert outcomes[0].result is None
        assert [o.result for o in outcomes[1:]] == [1, 2]
        assert "the page broke" in caplog.text

    def test_closed_it_shows_nothing_more(self):
        shown = []
        worker = Rescanner(lambda x: x, shown.append, delay=0.2)
        worker.ask(1)
        assert worker.close(10.0)
        time.sleep(0.3)
        assert shown == []


class TestScanControls:
    @pytest.mark.parametrize("name", SENSORS)
    def test_sliders_left_alone_change_no_sensor(self, name):
        base = SENSORS[name]
        assert ScanControls.of(base).sensor(base) == base

    def test_every_slider_of_the_sensor_does_something(self):
        base = Sensor()
        other = {
            "distance": (2.5, 3.0), "elevation": (10.0, 20.0), "object_size": 1.5, "baseline": 0.2,
            "projector": 2.0, "room_light": 0.0, "gain": 0.5, "image_noise": 3.0, "method": "zncc",
            "block_size": 11, "num_disparities": 256, "stride": 2, "material": "dark",
        }  # fmt: skip
        for name, value in other.items():
            import dataclasses

            assert dataclasses.replace(ScanControls(), **{name: value}).sensor(base) != base, name

    def test_settings_that_make_no_sensor_are_refused(self):
        with pytest.raises(InputError, match=r"beyond matching\.num_disparities"):
            ScanControls(num_disparities=16).sensor(Sensor())


class TestStore:
    @pytest.fixture
    def folder(self, tmp_path, rng):
        def row(index, label, split, twin=True):
            points = rng.normal(size=(5 + index, 3)).astype(np.float32)
            clean = rng.normal(size=(7, 3)).astype(np.float32)
            return CloudRow(
                f"o{index}", f"o{index}", 0, label, ("bed", "chair")[label], split, 3, points,
                np.full(len(points), index, np.uint8), clean, np.zeros(7, np.uint8), clean,
            )  # fmt: skip

        folder = tmp_path / "set"
        folder.mkdir()
        rows = [row(0, 0, "train"), row(1, 1, "test"), row(2, 1, "train")]
        write_manifest(
            folder,
            Manifest(class_names=("bed", "chair"), rows=3, shards=2, settings={}, versions={}),
        )
        write_shard(folder / "shard-00000.parquet", rows[:2])
        write_shard(folder / "shard-00001.parquet", rows[2:])
        return folder

    def test_objects_come_with_all_their_clouds(self, folder):
        found = StoreExhibits(folder)
        assert len(found) == 3
        assert found.labels == ("bed", "chair", "chair")
        last = found[2]
        assert last.name == "o2"
        assert {kind: len(cloud) for kind, cloud in last.clouds.items()} == {
            "points": 7, "clean": 7, "surface": 7
        }  # fmt: skip
        assert last.views["points"].tolist() == [2] * 7

    def test_order_is_that_of_load_clouds(self, folder):
        from qs3.io import load_clouds

        clouds = load_clouds(folder, split="train", num_points=5)
        found = StoreExhibits(folder, "train")
        assert tuple(found[i].name for i in range(len(found))) == clouds.ids

    def test_faults_name_the_folder(self, folder):
        with pytest.raises(InputError, match="no cloud of split 'val'; splits: test, train"):
            StoreExhibits(folder, "val")
        (folder / "shard-00001.parquet").unlink()
        with pytest.raises(InputError, match=r"set: unfinished, 1 of 2 shards"):
            StoreExhibits(folder)


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")
    listener = bind("127.0.0.1", 0)
    with serve(listener, "test") as server:
        yield server, listener.getsockname()[1]


class TestServing:
    def answer(self, port, path="/", **headers):
        asked = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
        try:
            with urllib.request.urlopen(asked, timeout=10) as got:  # noqa: S310
                return got.status, got.headers, got.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers, error.read()

    def test_hands_out_its_page_and_forbids_it_to_ask_others(self, server):
        status, headers, body = self.answer(server[1])
        assert status == 200
        assert b"viser" in body.lower()
        policy = headers["Content-Security-Policy"]
        assert f"ws://127.0.0.1:{server[1]};" in policy
        assert "http:" not in policy
        assert "*" not in policy

    @pytest.mark.parametrize(
        "path",
        ["/../viser/__init__.py", "/%2e%2e/%2e%2e/__init__.py", "//etc/passwd", "/..%5c__init__.py",
         "/index.html/../../../__init__.py", "/__init__.py", "/etc/passwd"],
    )  # fmt: skip
    def test_reads_no_file_of_the_disk(self, server, path):
        status, _, body = self.answer(server[1], path)
        assert status == 404
        assert body in (b"", b"NOT FOUND")

    def test_is_not_there_on_another_interface(self, server):
        """Nor on another loopback address: it does not listen on all."""
        found = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
        others = {str(one[4][0]) for one in found} - {"127.0.0.1"}
        for address in {"127.0.0.2", *others}:
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((address, server[1]), timeout=5)
        socket.create_connection(("127.0.0.1", server[1]), timeout=5).close()

    def test_other_sites_are_kept_out(self, server):
        import websockets.sync.client as client
        from websockets.exceptions import InvalidStatus

        port = server[1]
        assert self.answer(port, Host="example.org")[0] == 403
        import viser

        address, protocol = f"ws://127.0.0.1:{port}", f"viser-v{viser.__version__}"
        for origin in ("https://example.org", "null", f"http://example.org:{port}"):
            with pytest.raises(InvalidStatus, match="403"):
                client.connect(address, origin=origin, subprotocols=[protocol])
        own = f"http://127.0.0.1:{port}"
        with client.connect(address, origin=own, subprotocols=[protocol], max_size=None) as page:
            assert len(page.recv(timeout=10)) > 16

    def test_opens_no_tunnel(self, server, monkeypatch):
        import viser._viser

        monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_: pytest.fail("a tunnel"))
        assert server[0].request_share_url() is None

    def test_a_port_in_use_is_named(self, server):
        with pytest.raises(InputError, match=f"--port {server[1]} on 127.0.0.1: in use"):
            bind("127.0.0.1", server[1])

    @pytest.mark.parametrize(
        ("host", "port", "word"),
        [("no.such.host.invalid", 0, "no.such.host.invalid"), ("192.0.2.1", 0, "192.0.2.1"),
         ("127.0.0.1", 70000, "70000"), ("127.0.0.1", -1, "-1")],
    )  # fmt: skip
    def test_other_faults_are_named(self, host, port, word):
        with pytest.raises(InputError, match=word):
            bind(host, port)

    def test_the_port_is_free_again(self):
        pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")
        listener = bind("127.0.0.1", 0)
        port = listener.getsockname()[1]
        with serve(listener, "test"):
            pass
        bind("127.0.0.1", port).close()

    @pytest.mark.parametrize(
        ("host", "origin", "names", "wanted"),
        [
            ("127.0.0.1:80", None, None, True),
            ("[::1]:80", "http://[::1]:80", None, True),
            ("localhost:80", "http://127.0.0.1:80", None, False),
            ("192.0.2.1:80", None, None, False),
            ("evil.org:80", "http://evil.org:80", None, False),
            ("evil.org:80", "http://evil.org:80", {"mine", "localhost"}, False),
            ("mine:80", "http://mine:80", {"mine", "localhost"}, True),
            ("MINE:80", "http://MINE:80", {"mine", "localhost"}, True),
            ("192.0.2.1:80", "http://192.0.2.1:80", {"mine"}, True),
            ("[fe80::1]:80", "http://[fe80::1]:80", {"mine"}, True),
            ("mine:80", "http://evil.org", {"mine"}, False),
            ("", None, {"mine"}, False),
            ("localhost.evil.org", None, None, False),
            (None, None, None, False),
        ],
    )
    def test_who_is_let_in(self, host, origin, names, wanted):
        assert allowed(host, origin, None if names is None else frozenset(names)) is wanted

    def test_own_names_are_the_machines_and_the_one_given(self, monkeypatch):
        monkeypatch.setattr(socket, "gethostname", lambda: "Box")
        monkeypatch.setattr(socket, "getfqdn", lambda: "box.example.net")
        assert own_names("lab") == {"box", "box.example.net", "lab", "localhost"}
        assert "" not in own_names("")

    def test_on_every_interface_other_names_are_refused(self):
        """A site that lets its own name point here would read the data."""
        pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")
        listener = bind("0.0.0.0", 0)  # noqa: S104
        port = listener.getsockname()[1]
        with serve(listener, "test", "lab"):
            for name, code in (("evil.org", 403), ("lab", 200), (socket.gethostname(), 200)):
                own = f"{name}:{port}"
                assert self.answer(port, Host=own, Origin=f"http://{own}")[0] == code

    def test_loopback_is_known(self):
        hosts = ("127.0.0.1", "::1", "localhost", "0.0.0.0", "::")  # noqa: S104
        assert [is_loopback(h) for h in hosts] == [
            True, True, True, False, False
        ]  # fmt: skip

    def test_pages_show_faults_and_recover(self, server, rng):
        """The scan page with a scan that fails, then works; a slider asks for the next."""
        calls, item = threading.Semaphore(0), exhibit(rng)

        def scan(request):
            calls.release()
            if request.controls.views == 5:
                raise InputError("too many views")
            return item

        gui = server[0].gui
        with scan_page(
            server[0], scan, {"qs3": Sensor(), "d435": SENSORS["d435"]}, ScanControls(), 3
        ) as stage:
            assert calls.acquire(timeout=10)
            wait_for(lambda: "too many views" in stage._state.content)
            handles = {h.label: h for h in gui._gui_input_handle_from_uuid.values()}
            handles["Views"].value = 2
            assert calls.acquire(timeout=10)
            wait_for(lambda: "chair" in stage._text.content)
            assert stage._state.content == ""
            handles["Sensor"].value = "d435"
            assert calls.acquire(timeout=10)
            now = {h.label: h.value for h in gui._gui_input_handle_from_uuid.values()}
            assert now["Distance (m)"] == (1.2, 2.0)
            assert now["Views"] == 2
        gui.reset()

    def test_gallery_steps_and_filters(self, server, rng):
        points = rng.normal(size=(4, 6, 3)).astype(np.float32)
        items = ArrayExhibits(points, ("a0", "b0", "a1", "b1"), ("a", "b", "a", "b"))
        answers = Answers(np.array([[1.0, 0]] * 4), ("a", "b"), np.array([0, 1, 0, 1]))
        gui = server[0].gui
        with gallery_page(server[0], items, answers, "b") as stage:
            handles = {h.label: h for h in gui._gui_input_handle_from_uuid.values()}
            wait_for(lambda: "b0" in stage._text.content)
            assert handles["Object"].max == 2
            handles["Object"].value = 2
            wait_for(lambda: "b1" in stage._text.content)
            handles["Wrong ones only"].value = True
            wait_for(lambda: "b0" in stage._text.content)
            handles["Class"].value = "a"
            wait_for(lambda: "none of this class is wrong" in stage._state.content)
        gui.reset()
        with pytest.raises(InputError, match="--class-name c: no object of it; classes here: a, b"):
            gallery_page(server[0], items, None, "c").__enter__()
        gui.reset()


def wait_for(met, seconds=10.0):
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "did not come about"
        time.sleep(0.02)
