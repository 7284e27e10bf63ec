"""The viewer without its server: what is shown is right, and the last change wins."""

import dataclasses
import threading
import time

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.report.figure import PALETTE
from qs3.sensor.presets import SENSORS
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.scene import SceneSettings
from qs3.sensor.settings import ScanSettings
from qs3.viewer.colouring import by_error, by_height, by_view, round_limit
from qs3.viewer.display import compose, frame_of, modes
from qs3.viewer.distance import mesh_distance, spacing
from qs3.viewer.exhibits import Answers, Exhibit, StoreExhibits
from qs3.viewer.rescan import Rescanner
from qs3.viewer.scan_controls import make_controls, resolve, with_controls

from ..stores import write_store

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

    def test_spacing_of_a_single_point_is_none(self):
        assert spacing(np.zeros((1, 3))) == 0


class TestColours:
    def test_views_have_the_palette_and_the_legend_counts_them(self):
        view = np.array([0, 0, 11], dtype=np.uint8)
        colouring = by_view(view)
        expected = [tuple(int(PALETTE[i][k : k + 2], 16) for k in (1, 3, 5)) for i in (0, 0, 1)]
        assert [tuple(c) for c in colouring.colours.tolist()] == expected
        assert colouring.swatches == (
            (PALETTE[0], "view 1 (2 points)"),
            (PALETTE[1], "view 12 (1 point)"),
        )

    def test_errors_share_a_scale_and_stop_at_its_end(self):
        colouring = by_error(np.array([0.0, 0.5, 1.0, 9.0]), "the mesh", 1.0, " m")
        low, middle, high, beyond = colouring.colours.tolist()
        assert high == beyond != middle != low
        assert colouring.ends == ("0 m", "1 m and more")
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
        assert dict(wrong.facts)["its answer"] == "wrong: bed, labelled chair"
        assert dict(right.facts)["its answer"] == right.colouring.title == "right: chair"
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

        worker = Rescanner(work, lambda value: (shown.append(value), last.set()), delay=0.0)
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
        worker = Rescanner(worked.append, lambda _: done.set(), delay=0.1)
        for value in range(5):
            worker.ask(value)
        assert done.wait(10)
        worker.close(10.0)
        assert worked == [4]

    def test_faults_are_shown_and_the_worker_lives_on(self, caplog):
        shown, faults, more = [], [], threading.Semaphore(0)

        def work(value):
            if value == 0:
                raise InputError("no such thing")
            return value

        def show(value):
            shown.append(value)
            more.release()
            if value == 1:
                raise RuntimeError("the page broke")

        worker = Rescanner(work, show, lambda e: (faults.append(str(e)), more.release()), delay=0.0)
        for value in (0, 1, 2):
            worker.ask(value)
            assert more.acquire(timeout=10)
        worker.close(10.0)
        assert faults == ["no such thing"]
        assert shown == [1, 2]
        assert "the page broke" in caplog.text

    def test_closed_it_shows_nothing_more(self):
        shown = []
        worker = Rescanner(lambda x: x, shown.append, delay=0.05)
        worker.ask(1)
        assert worker.close(10.0)
        time.sleep(0.1)
        assert shown == []


def values_of(settings: ScanSettings) -> dict:
    return {control.name: control.value for control in make_controls(settings)}


class TestScanControls:
    @pytest.mark.parametrize("name", SENSORS)
    def test_controls_left_alone_change_nothing(self, name):
        start = resolve(ScanSettings(sensor=name, renderer=MitsubaRenderer(variant="scalar_rgb")))
        same = with_controls(start, values_of(start))
        assert same == start
        assert same.make_sensor() == SENSORS[name]

    def test_a_scene_and_a_renderer_of_ones_own_stay(self):
        @dataclasses.dataclass(frozen=True)
        class OwnRenderer:
            """It has no rays to count."""

            description = ()

            def render(self, *scene): ...

        scene = SceneSettings("floor", neighbour_size=0.5)
        start = resolve(ScanSettings(scene=scene, renderer=OwnRenderer()))
        assert with_controls(start, values_of(start)) == start
        assert with_controls(start, values_of(start) | {"scene": "wall"}).scene == "wall"

    def test_every_control_does_something(self):
        start = resolve(ScanSettings(renderer=MitsubaRenderer(variant="scalar_rgb")))
        other = {
            "views": 2, "view_layout": "jitter", "num_points": 64, "scene": "floor", "crop": "none",
            "seed": 1, "samples": 2, "placement.radius": (2.5, 3.0), "object_size": 1.5,
            "placement.elevation": (10.0, 20.0), "rig.baseline": 0.2, "projector": 2.0,
            "room light": 0.0, "gain": 0.5, "exposure.noise": 3.0, "matching.method": "zncc",
            "matching.block_size": 11, "matching.num_disparities": 256, "depth.stride": 2,
            "material": "dark",
        }  # fmt: skip
        assert set(other) == set(values_of(start))
        for name, value in other.items():
            assert with_controls(start, {name: value}) != start, name

    def test_what_the_command_line_changes_is_where_a_control_begins(self):
        renderer = MitsubaRenderer(variant="scalar_rgb", samples=7)
        start = resolve(ScanSettings(image_noise=2.0, preset="released", renderer=renderer))
        values = values_of(start)
        assert (values["exposure.noise"], values["view_layout"], values["samples"]) == (
            2.0, "jitter", 7
        )  # fmt: skip
        assert with_controls(start, {"exposure.noise": 0.0}).make_sensor().exposure.noise == 0

    def test_settings_are_changed_at_once_and_those_that_make_no_sensor_are_refused(self):
        start = resolve(ScanSettings(renderer=MitsubaRenderer(variant="scalar_rgb")))
        few = {"matching.num_disparities": 16}
        with pytest.raises(InputError, match=r"beyond matching\.num_disparities"):
            with_controls(start, few)
        with_controls(start, few | {"rig.baseline": 0.005})


class TestStore:
    @pytest.fixture
    def folder(self, tmp_path):
        rows = [(0, "train", 5), (1, "test", 6), (1, "train", 7)]
        return write_store(tmp_path / "set", ("bed", "chair"), rows, shards=2)

    def test_objects_come_with_all_their_clouds(self, folder):
        exhibits = StoreExhibits(folder)
        assert len(exhibits) == 3
        assert exhibits.labels == ("bed", "chair", "chair")
        last = exhibits[2]
        assert last.name == "o2#0"
        assert {kind: len(cloud) for kind, cloud in last.clouds.items()} == {
            "points": 7, "clean": 7, "surface": 7
        }  # fmt: skip
        assert last.views["points"].tolist() == [2] * 7

    def test_order_is_that_of_load_clouds(self, folder):
        from qs3.io import load_clouds

        clouds = load_clouds(folder, split="train", num_points=5)
        exhibits = StoreExhibits(folder, "train")
        assert tuple(exhibits[i].name for i in range(len(exhibits))) == clouds.ids

    def test_faults_name_the_folder(self, folder):
        with pytest.raises(InputError, match="no cloud of split 'val'; splits: test, train"):
            StoreExhibits(folder, "val")
        (folder / "shard-00001.parquet").unlink()
        with pytest.raises(InputError, match=r"set: unfinished, 1 of 2 shards"):
            StoreExhibits(folder)
