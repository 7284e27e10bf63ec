"""An extraction goes on where it stopped; a scene that fails costs itself alone."""

from dataclasses import dataclass

import numpy as np
import pytest

from qs3.clouds.layouts.store import read_ragged
from qs3.errors import InputError
from qs3.objects.run import ExtractedCloud, OutputSettings, run_extract
from qs3.store.info import check
from qs3.store.manifest import read_failures


@dataclass(frozen=True)
class Scene:
    id: str


SCENES = [Scene(f"scene{i}") for i in range(4)]


def cut(scene: Scene):
    points = np.random.default_rng(int(scene.id[-1])).random((20, 3), np.float32)
    yield ExtractedCloud(f"{scene.id}/0", "chair", points)


def run(folder, extract_one=cut, **options):
    output = OutputSettings(str(folder), num_points=16, **({"workers": 0} | options))
    return run_extract(SCENES, extract_one, output, settings={}, class_names=("chair",))


def content(folder):
    return {path.name: path.read_bytes() for path in folder.glob("[!.]*")}


def test_scenes_of_one_name_are_refused(tmp_path):
    output = OutputSettings(str(tmp_path / "out"), workers=0)
    with pytest.raises(InputError, match="two scenes or frames have one name; rename one"):
        run_extract([*SCENES, Scene("scene1")], cut, output, settings={}, class_names=("chair",))
    assert not (tmp_path / "out").exists()


def test_a_stopped_extraction_goes_on_and_a_failed_scene_is_retried(tmp_path):
    def stopped(scene):
        if scene.id == "scene2":
            raise KeyboardInterrupt
        return cut(scene)

    def failing(scene):
        if scene.id == "scene3":
            raise ValueError("no mask")
        return cut(scene)

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(out, stopped)
    report = run(out, failing)
    assert (report.objects, report.units, report.skipped, report.failed) == (3, 2, 2, 1)
    (failure,) = read_failures(out)
    assert (failure["id"], failure["reason"]) == ("scene3", "no mask")
    assert run(out, failing).units == 0
    assert run(out, failing, retry_failed=True).failed == 1
    report = run(out, retry_failed=True)
    assert (report.objects, report.failed) == (4, 0)
    assert check(out, progress=False) == []
    run(tmp_path / "whole", workers=1)
    assert content(out) == content(tmp_path / "whole")
    assert [len(cloud) for cloud in read_ragged(out).clouds] == [16] * 4
