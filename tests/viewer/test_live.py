"""The page of ``qs3 watch``: the objects of the last frame alone, coloured by their answers."""

import numpy as np
import pytest

from qs3.io.extract.segment import SegmentedObject
from qs3.training.answers import Answer
from qs3.training.watch import SeenFrame, SeenObject

pytest.importorskip("viser")
from qs3.viewer.live import Live
from qs3.viewer.serving import serve

HOSTILE = "<img src=x onerror=alert(1)>"


def seen(x, shares, unfamiliar=None):
    points = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    item = SegmentedObject(points, (x, 0.5, 0.1), (0.2, 0.1, 0.2), 0.0)
    familiarity = None if unfamiliar is None else 1 - unfamiliar
    answer = Answer(probabilities=shares, familiarity=familiarity, refused=unfamiliar is not None)
    return SeenObject(item, answer)


def test_the_last_frame_is_drawn_and_told():
    chair, lamp = {"chair": 0.9, "lamp": 0.1}, {"lamp": 0.8, "chair": 0.2}
    with serve(0, "watch") as server:
        live = Live(server)
        first = (seen(0.0, chair), seen(0.3, lamp), seen(0.6, lamp, 0.97))
        live.show(SeenFrame("000000", None, first, (0.1, 0.1, 0.1)), "2 a second")
        clouds, labels = live._drawn[::2], live._drawn[1::2]
        assert [label.text for label in labels] == ["chair 0.90", "lamp 0.80", "unknown 0.97"]
        assert [float(label.position[0]) for label in labels] == pytest.approx([0.0, 0.3, 0.6])
        assert len({tuple(np.ravel(cloud.colors)[:3]) for cloud in clouds}) == 3
        assert "2 a second" in live._text.content
        live.show(SeenFrame("000001", None, (seen(0.1, lamp),), (0.1, 0.1, 0.1)), "")
        assert [handle.name for handle in live._drawn] == ["/object/0", "/label/0"]
        live.show(SeenFrame(HOSTILE, None, (), (0.1, 0.1, 0.1), HOSTILE), HOSTILE)
        assert live._drawn == []
        assert "<img" not in live._text.content
