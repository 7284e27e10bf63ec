"""A table's numbers are those of its records; what is no record of it is refused by name."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer

from qs3.cli.figure import figure
from qs3.cli.table import TableOptions, table
from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, append_record
from qs3.paper.figures import draw, picture
from qs3.paper.scales import SCALES
from qs3.paper.setup import Setup, read_setup
from qs3.paper.table import Table
from qs3.paper.table_text import FORMATS, markdown

from .conftest import drop, records_of, rewrite

COLUMNS = ("M-D", "S-D", "S-F")


def change(folder, name, *fields, value):
    """Change a field of a record."""

    def changed(of, whole):
        inner = whole
        for field in fields[:-1] if of == name else ():
            inner = inner[field]
        if of == name:
            inner[fields[-1]] = value
        return whole

    rewrite(folder, changed)


def read(folder, name, **changes):
    return Table(name, read_setup(folder), **changes)


def record(folder, name):
    return records_of(folder)[name]


def test_numbers_are_those_of_the_records(whole):
    text = markdown(read(whole, "ordinary", columns=COLUMNS))
    assert text.startswith("# *smoke* — Networks without adaptation")
    assert "**Stand-ins, made here**" in text and "ScanNet10 (S*)" in text
    line = ["DGCNN"]
    for task, paper in zip(COLUMNS, ("46.7 ± 1.4", "64.0 ± 1.0", "51.1 ± 1.2"), strict=True):
        scores = [record(whole, f"{task}_ordinary@dgcnn_seed-{seed}").scores for seed in (0, 1)]
        values = 100 * np.array([score.accuracy for score in scores])
        sem = values.std(ddof=1) / np.sqrt(2)
        line += [f"{values.mean():.1f} ± {sem:.1f} (n=2)", paper]
    assert f"| {' | '.join(line)} |" in text
    rows = list(csv.DictReader((whole / "ordinary.csv").read_text().splitlines()))
    assert len(rows) == 3 * 2 * 2
    for row in rows:
        network = {"pointnet": "", "dgcnn": "@dgcnn"}[row["row"]]  # the bench's own, and another
        name = f"{row['column']}_ordinary{network}_seed-{row['seed']}"
        assert float(row["accuracy"]) == record(whole, name).scores.accuracy
    assert (whole / "ordinary.tex").read_text().count(r" \\") == 3


def test_the_bench_shows_what_rounds_kept(whole):
    text = (whole / "uda.md").read_text()
    run = record(whole, "S-D_qbst_seed-0")
    kept = run.rounds[-1]
    # All that was kept is of the target's clouds, whose labels were looked at afterwards.
    assert kept["known"] == kept["kept"] and sum(kept["right"]) <= sum(kept["kept"])
    pairs = zip(kept["kept"], kept["right"], strict=True)
    cells = [f"{count:.1f} / {right:.1f}" for count, right in pairs]
    cells.append(f"{sum(kept['kept']):.1f} of {sum(kept['confident']):.1f}")
    assert f"| QBST, our settings | {' | '.join(cells)} | " in text


def test_differences_are_paired_over_seeds(whole):
    filled = read(whole, "ordinary", columns=COLUMNS)
    what, difference = next(pair for pair in filled.differences() if "DGCNN" in pair[0])
    assert what == "S over M on D, DGCNN"
    first, second = (
        [record(whole, f"{task}_ordinary@dgcnn_seed-{seed}").scores.accuracy for seed in (0, 1)]
        for task in ("S-D", "M-D")
    )
    assert difference.mean == pytest.approx(np.mean(np.subtract(first, second)))
    assert f"- {what}: {difference.format()}" in (whole / "ordinary.md").read_text()


def test_one_training_of_a_source_serves_all_targets(whole):
    records = [record(whole, f"{task}_ordinary@dgcnn_seed-0") for task in ("S-D", "S-F")]
    assert records[0].source == records[1].source and records[0].target is None
    assert [run.test.cloud for run in records] == ["points", "clean"]
    assert records[0].seconds == records[1].seconds
    settings = json.loads((whole / "runs/S-D/qbst/seed-0/settings.json").read_text())
    assert settings["warm_up"] is not None
    warm_up, rounds = (record(whole, f"S-D_{row}_seed-0") for row in ("ordinary", "qbst"))
    assert rounds.steps["warm-up"] == warm_up.steps["total"] > 0
    minutes = (rounds.cpu_seconds["total"] + rounds.cpu_seconds["warm-up"]) / 60
    steps = rounds.steps["total"] + rounds.steps["warm-up"]
    share = f"{100 * rounds.source_accuracy:.1f} %"
    each = 60 * minutes / (100 * rounds.scores.accuracy)
    text = (whole / "uda.md").read_text()
    assert f"| QBST, our settings | {minutes:.1f} · {each:.1f} · {steps:,} · {share} |" in text
    assert not (whole / "runs/S-D/qbst/seed-0/warm-up").exists()


def test_cells_that_wait_show_the_command(finished, capsys):
    drop(finished, *(f"S-F_ordinary@dgcnn_seed-{seed}" for seed in (0, 1)))
    assert table(TableOptions("ordinary", finished, tasks=COLUMNS)) == 0
    printed = capsys.readouterr().out
    assert "1 cells wait for runs" in printed
    # Of what was asked for alone: all lines and columns would be hours.
    rest = "--scale smoke --tasks M-D S-D S-F --seeds 0 1"
    command = f"qs3 reproduce ordinary --out {finished} {rest}"
    assert f"    {command}\n" in printed
    assert next(line for line in printed.splitlines() if line.startswith("| DGCNN")).count("…") == 1


def test_damaged_and_foreign_records_are_refused_and_the_rest_shown(finished, capsys):
    place = record(finished, "M-D_ordinary@dgcnn_seed-1").experiment
    drop(finished, "S-D_ordinary@dgcnn_seed-0", "M-D_ordinary@dgcnn_seed-1")
    change(finished, "S-F_ordinary@dgcnn_seed-1", "test", "checksum", value="0")
    foreign = dataclasses.replace(record(finished, "S-D_ordinary@dgcnn_seed-1"), experiment=place)
    append_record(finished / RECORDS, foreign)
    with (finished / RECORDS).open("a") as file:
        file.write("{\n")
    assert table(TableOptions("ordinary", finished, tasks=COLUMNS)) == 1
    out, err = capsys.readouterr()
    refused = [line for line in err.splitlines() if "refused" in line]
    assert len(refused) == 3
    for name, why in (
        ("records.jsonl:", "JSON"),
        ("M-D_ordinary@dgcnn_seed-1", "source is "),
        ("S-F_ordinary@dgcnn_seed-1", "other data (test F)"),
    ):
        assert sum(name in line and why in line for line in refused) == 1
    assert "n=1)" in out


@pytest.mark.parametrize(
    ("fields", "value", "message"),
    [
        (["seed"], "0", "'seed'"),
        (["seed"], 7, "seed is 7, not 0"),
        (["method"], "spst", "method is spst, not qbst"),
        (["settings", "train", "epochs"], 5, "train.epochs is 5, not 4"),
        (["settings", "train", "epoch"], 4, "epoch"),
        (["settings", "self_training"], None, "self_training.epochs is None"),
        (["marks"], ["supervised"], "supervised is True"),
        (["test", "split"], "train", "test is "),
        (["source", "cloud"], "clean", "source is "),
        (["extra"], 1, "'extra' is unknown"),
    ],
)
def test_a_record_of_another_run_is_reported_with_the_difference(finished, fields, value, message):
    change(finished, "S-D_qbst_seed-0", *fields, value=value)
    filled = read(finished, "uda", rows=("qbst",), columns=("S-D",))
    (fault,) = filled.faults
    assert str(finished / RECORDS) in fault and message in fault and not filled.records


def test_a_mean_over_runs_of_other_networks_is_refused(finished):
    name = "S-D_ordinary@dgcnn_seed-1"
    change(finished, name, "settings", "class_names", value=["chair"])
    with pytest.raises(InputError, match="not in the seed alone"):
        markdown(read(finished, "ordinary", columns=COLUMNS))


def test_caveats_of_runs_stand_below_the_table(finished):
    change(finished, "S-D_ordinary@dgcnn_seed-0", "marks", value=["training clouds"])
    filled = read(finished, "ordinary", columns=COLUMNS)
    assert "- training clouds: DGCNN on S → D" in FORMATS["md"](filled)
    assert "% training clouds: DGCNN on S → D" in FORMATS["tex"](filled)
    assert FORMATS["csv"](filled).count("training clouds") == 2
    name = "M-D_qbst-theta-0.2_seed-0"
    of_run = record(finished, name).rounds
    rounds = [{**done, "skipped": n == 1} for n, done in enumerate(of_run)]
    change(finished, name, "rounds", value=rounds)
    text = markdown(read(finished, "thresholds"))
    assert "- 1 of 2 rounds skipped, confident clouds too few: QBST, M → D on θ₀ = 0.2" in text
    assert text.count("n=1) (1 of 2 rounds trained)") == 2
    change(finished, name, "rounds", value=[done | {"skipped": True} for done in rounds])
    for kind in ("md", "tex"):
        assert FORMATS[kind](read(finished, "thresholds")).count("n=1) (no round trained)") >= 1
    assert "Self-training here: threshold 0.0, rounds 2, epochs 1 (paper: 0.8, 10, 10)." in text


def test_figures_are_the_same_bytes_each_time(whole, tmp_path, capsys):
    filled = read(whole, "thresholds")
    assert picture(filled, "png") == picture(filled, "png")
    assert (whole / "thresholds.png").read_bytes()[1:4] == b"PNG"
    path, options = tmp_path / "lines.svg", TableOptions("thresholds", whole)
    assert figure(options, path) == 0
    assert "S → D" in path.read_text()
    assert capsys.readouterr().out.split() == [str(path)]
    for place in (path, tmp_path / "lines.png"):
        assert figure(options, place) == figure(options, place) == 0  # its own picture goes
        place.write_bytes(b"a picture of another program")
        with pytest.raises(InputError, match=f"{place}: is no such picture of qs3"):
            figure(options, place)
    for name in ("a.jpg", "a"):
        with pytest.raises(InputError, match=r"\.png or \.svg"):
            figure(options, tmp_path / name)
    with pytest.raises(InputError, match="ordinary: its columns are no numbers, so it has no fig"):
        figure(TableOptions("ordinary", whole), tmp_path / "ordinary.svg")


def test_figures_have_the_width_of_a_column_and_the_intervals_of_the_table(whole):
    filled = read(whole, "thresholds")
    figure = draw(filled)
    assert figure.get_size_inches()[0] < 6 and len(figure.axes) == 2
    assert "1 seed, 95 % intervals over clouds" in figure.get_suptitle()
    lines, *_ = [c for c in figure.axes[0].containers if isinstance(c, ErrorbarContainer)]
    (_, low), (_, high) = lines.lines[2][0].get_segments()[1]  # M → D, the second threshold
    score = filled.means["M", "qbst-theta-0.2"]["accuracy"]
    assert [low, high] == pytest.approx([100 * end for end in score.interval])


def test_a_figure_without_a_record_is_drawn(tmp_path):
    figure = draw(Table("thresholds", Setup(tmp_path, SCALES["smoke"])))
    assert figure.axes[0].get_xlabel() == "θ₀"


def test_the_text_describes_the_training_of_the_table_s_networks(tmp_path):
    text = markdown(Table("ordinary", Setup(tmp_path, SCALES["paper"], seeds=(0,))))
    assert "1000 epochs, batches of 32, schedule cosine" in text
    assert "418 objects a class of M and S" in text
