import dataclasses

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.tables import group, markdown


def test_runs_that_differ_in_the_seed_are_averaged(with_accuracy):
    values = [0.5, 0.6, 0.8]
    records = [with_accuracy(seed, value) for seed, value in enumerate(values)]
    other = with_accuracy(0, 0.1, method="source-only", target=None, marks=())
    rows = group([*records, other])
    assert [row.key[0] for row in rows] == ["qbst", "source-only"]
    assert rows[0].accuracy.mean == pytest.approx(np.mean(values))
    assert rows[0].accuracy.sem == pytest.approx(np.std(values, ddof=1) / np.sqrt(3))
    assert rows[0].seeds == (0, 1, 2)
    assert rows[0].key[1:] == ("dgcnn", "cad/train", "rooms", "rooms", "last", "transductive")
    assert rows[1].key[3] == "-"


def test_a_mean_over_unlike_runs_is_refused(with_accuracy, record):
    one, two = with_accuracy(0, 0.5), with_accuracy(1, 0.6)
    with pytest.raises(InputError, match="one seed"):
        group([one, one])
    with pytest.raises(InputError, match="not in the seed alone"):
        group([one, dataclasses.replace(two, settings={"theta": 0.9})])
    with pytest.raises(InputError, match="not in the seed alone"):
        data = dataclasses.replace(record.test, checksum="c" * 64)
        group([one, dataclasses.replace(two, test=data)])
    clean = dataclasses.replace(two, source=dataclasses.replace(two.source, cloud="clean"))
    assert [row.key[2] for row in group([one, clean])] == ["cad/train", "cad/train (clean)"]


def test_seeds_of_real_runs_lie_deeper(with_accuracy):
    def settings(seed, warm_up, epochs=3):
        return {"train": {"seed": seed, "epochs": epochs}, "warm_up": warm_up}

    one = with_accuracy(0, 0.5, settings=settings(0, "weights of seed 0"))
    two = with_accuracy(1, 0.6, settings=settings(1, "weights of seed 1"))
    assert group([one, two])[0].seeds == (0, 1)
    for other in (settings(1, None), settings(1, "weights of seed 1", epochs=4)):
        with pytest.raises(InputError, match="not in the seed alone"):
            group([one, dataclasses.replace(two, settings=other)])


def test_markdown_shows_mean_error_and_number_of_seeds(with_accuracy):
    rows = group([with_accuracy(0, 0.5), with_accuracy(1, 0.6)])
    lines = markdown(rows).splitlines()
    assert lines[0].endswith("| accuracy % | class-mean accuracy % |")
    assert "| 55.0 ± 5.0 (n=2) |" in lines[2]
    assert len({line.count("|") for line in lines}) == 1
    with pytest.raises(ValueError, match="1 headers"):
        markdown(rows, ("method",))
