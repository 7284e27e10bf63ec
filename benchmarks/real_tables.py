"""Tables of `benchmarks/real.py`: means over seeds, differences with intervals, the goals.

Run: python benchmarks/real_tables.py [--records results/real] [--out runs/real --shared DIR]
         [--picture docs/images/mended.png]

With --out, the runs of that folder are asked anew which clouds they have right; that goes, as
noughts and ones in the order of filming, into right.csv beside the records. The tables come from
the records and right.csv alone. Intervals draw seeds, and blocks of ten frames (rooms) of clouds.
--picture draws ten of NYU's objects that self-training from `rooms` mended, and ten that it broke.
"""

import argparse
import functools
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from real import bootstrap_difference, parts, recorded

from qs3.clouds.layouts.npz import frame_parts
from qs3.evaluation.records import RunRecord
from qs3.evaluation.tables import average, frame, to_markdown
from qs3.report.clouds import draw_cloud
from qs3.training import load_model, predict_probabilities
from qs3.training.predict import describe
from qs3.training.prepared import prepare_clouds

RIGHT = "right.csv"
TABLES = "tables.md"
ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "docs" / "real.md",)
"""What shows tables, between marks."""
NAMES = {"dev": "NYU, first 70 %", "check": "NYU, last 30 %", "sunrgbd": "SUN RGB-D"}
PAIRS = (
    ("S", "M"), ("S", "C"), ("C", "M"), ("S+C+M", "M"), ("S+C+M", "S"), ("QBST", "S+C+M"),
    ("SPST", "S+C+M"), ("QBST", "SPST"), ("DGCNN S", "DGCNN M"), ("DGCNN S+C+M", "DGCNN M"),
    ("DGCNN S+C+M", "DGCNN S"), ("DGCNN S", "S again"),
    ("DGCNN QBST", "DGCNN S+C+M"), ("DGCNN QBST gentle", "DGCNN S+C+M"),
    ("rooms, height", "rooms"),
    ("rooms", "S+C+M"), ("rooms", "M"), ("M sight", "M"), ("S again", "M sight"),
    ("rooms QBST average", "rooms"), ("rooms QBST gentle", "rooms"),
    ("rooms SPST gentle", "rooms"), ("rooms QBST gentle", "rooms SPST gentle"),
    ("rooms QBST gentle, more", "rooms"),
    ("rooms SPST", "rooms"), ("rooms QBST average", "rooms SPST"), ("rooms DGCNN", "rooms"),
    ("S lit", "S"), ("S lit", "M"), ("S+C+M lit", "S+C+M"), ("rooms lit", "rooms"),
    ("rooms lit", "S lit"), ("S again", "M"), ("S again", "S lit"),
    ("rooms, light mended", "rooms"), ("rooms, light mended", "rooms lit"),
    ("S QBST paper", "S again"), ("S SPST", "S again"),
    ("S QBST", "S again"), ("S QBST gentle", "S again"), ("S QBST paper", "S SPST"),
    ("S QBST", "S SPST"), ("S QBST gentle", "S SPST"), ("S QBST gentle, alone", "S again"),
    ("S QBST gentle", "S QBST gentle, alone"),
    ("S SD", "S again"),
    ("S SD+QBST", "S SD"), ("S SD+QBST", "S again"), ("S GAST", "S again"),
    ("S GAST+QBST", "S GAST"), ("S GAST+QBST", "S again"),
    ("S SD+QBST gentle", "S SD"), ("S GAST+QBST gentle", "S GAST"),
    ("S GAST+QBST gentle", "S again"), ("S QBST gentle", "S GAST"), ("S QBST gentle", "S SD"),
    ("full QBST gentle", "full augmentation"),
)  # fmt: skip
"""First minus second."""
SWITCHES = {
    "S QBST": ("S QBST by share", "S QBST average"),
    "S again": ("no size", "strays kept", "unit ball", "same points", "paper's way",
                "no augmentation", "full augmentation", "more cuts", "aligned", "sight"),
}  # fmt: skip
"""Against what each switch is held."""
TITLES = {
    "M": "whole surfaces (M)", "C": "what a camera sees, without noise (C)", "S": "our scans (S)",
    "S lit": "the same, the D4xx in a lit room, as they are now",
    "S+C+M": "all three", "QBST": "all three, then QBST (preset `default`)",
    "SPST": "all three, then SPST",
    "rooms": "**`rooms`**",
    "rooms, light mended": "`rooms`, its scans made again in the mended light",
    "rooms, height": "**`rooms`**, which knows the height above the floor",
    "rooms QBST gentle": "`rooms`, then gentle QBST",
    "rooms SPST gentle": "`rooms`, then gentle SPST", "rooms DGCNN": "`rooms` with a DGCNN",
}  # fmt: skip
"""Lines of the short table."""
SHORT, SCORES = "## In short, accuracy / class mean", "## Scores"


def read_records(folder: Path) -> list[RunRecord]:
    return list(recorded(folder).values())


def place(record: RunRecord) -> tuple[str, str]:
    """Cell and part of a record."""
    assert record.experiment is not None, record.test.name
    return str(record.experiment["cell"]), str(record.experiment["part"])


def note_right(out: Path, shared: Path, folder: Path) -> None:
    """Ask finished runs which real clouds they have right."""
    clouds = parts(shared)
    path = folder / RIGHT
    lines = pd.read_csv(path, dtype=str).to_dict("records") if path.is_file() else []
    known = {(line["cell"], line["part"], int(line["seed"])) for line in lines}
    prepare = functools.cache(lambda part, *rest: prepare_clouds(clouds[part], *rest))
    for record in read_records(folder):
        (cell, part), seed = place(record), record.seed
        if part not in clouds or (cell, part, seed) in known:
            continue
        loaded, data = load_model(out / f"{cell}-{seed}"), clouds[part]
        names = [loaded.class_names.index(name) for name in data.class_names]
        prepared = prepare(part, loaded.num_points, loaded.preparation)
        answers = describe(loaded.model, prepared).probabilities.argmax(axis=1)
        right = np.array(names)[data.labels] == answers
        if round(right.mean(), 9) != round(record.scores.accuracy, 9):
            raise SystemExit(f"{cell}-{seed}, {part}: the run is not that of its record")
        bits = "".join(str(int(bit)) for bit in right)
        lines.append({"part": part, "cell": cell, "seed": str(seed), "right": bits})
    with np.load(shared / "nyuv2_objects.npz") as archive:
        strict, frame_number = archive["strict"].astype(bool), archive["frame"]
    lines = [line for line in lines if line["cell"] != "(block)"]
    for name, rows in frame_parts(frame_number, strict).items():
        part = name.removeprefix("strict-")
        blocks = np.unique(frame_number[rows] // 10, return_inverse=True)[1]
        text = " ".join(str(block) for block in blocks)
        lines.append({"part": part, "cell": "(block)", "seed": "-1", "right": text})
    table = pd.DataFrame(lines, columns=["part", "cell", "seed", "right"])
    table = table.sort_values(["part", "cell", "seed"])
    table.to_csv(path, index=False, lineterminator="\n")


def tables(folder: Path) -> str:
    """Return all tables as Markdown."""
    records = read_records(folder)
    right = pd.read_csv(folder / RIGHT, dtype=str)
    bits = {
        (line.part, line.cell, int(line.seed)): np.array([bit == "1" for bit in line.right])
        for line in right.itertuples()
        if line.cell != "(block)"
    }
    blocks = {
        line.part: np.array([int(word) for word in line.right.split()])
        for line in right.itertuples()
        if line.cell == "(block)"
    }
    looked = [part for part in NAMES if any(place(record)[1] == part for record in records)]
    fields = [dict(zip(("cell", "part"), place(record), strict=True)) for record in records]
    averages = average(frame(records, fields), ("cell", "part"))
    text = ["Made by `python benchmarks/real_tables.py`; not written by hand.", "", SHORT, ""]
    text += [to_markdown(short_table(averages)), "", SCORES, ""]
    text += ["With one seed (n=1), brackets hold Wilson's 95 % interval over the clouds.", ""]
    text += [to_markdown(score_table(averages, looked)), ""]
    for part in looked:
        if part in blocks:
            text += [f"## Differences on {NAMES[part]}", "", "Points of accuracy; first minus"]
            text[-1] += " second, on the same seeds and clouds; 95 % interval over both."
            means = {
                (place(record)[0], record.seed): record.scores.class_mean_accuracy
                for record in records
                if place(record)[1] == part
            }
            text += ["", to_markdown(differences(bits, blocks[part], part, PAIRS, means)), ""]
            switches = [(one, base) for base, ones in SWITCHES.items() for one in ones]
            ablations = differences(bits, blocks[part], part, switches, means)
            if len(ablations):
                text += ["Switches, one at a time:", "", to_markdown(ablations), ""]
    rounds = round_table(records)
    if len(rounds):
        text += ["## Rounds of self-training, seed 0", "", to_markdown(rounds), ""]
    for part in looked:
        for cell in ("M", "S+C+M", "QBST", "rooms", "rooms QBST average"):
            text += confusion(records, cell, part) if part != "sunrgbd" else []
    return "\n".join(text).rstrip() + "\n"


def score_table(means: pd.DataFrame, looked: list[str]) -> pd.DataFrame:
    by_part = {name: group.set_index("cell") for name, group in means.groupby("part")}
    lines = []
    for cell in dict.fromkeys(means["cell"]):
        row = by_part["dev"].loc[cell]
        line = {"cell": cell, "seeds": len(row["seeds"])}
        line["own source"] = "–"
        if cell in by_part["source"].index:
            line["own source"] = f"{100 * by_part['source'].loc[cell]['accuracy'].mean:.1f}"
        for part in looked:
            group = by_part[part]
            scores = group.loc[cell] if cell in group.index else None
            for name, head in (("accuracy", ""), ("class_mean_accuracy", ", class mean")):
                value = "–" if scores is None else scores[name].format()
                line[NAMES[part] + head] = value
        line["rounds that trained"] = (
            f"{row['trained']} of {row['rounds']}" if row["rounds"] else "–"
        )
        lines.append(line)
    return pd.DataFrame(lines)


def short_table(averages: pd.DataFrame) -> pd.DataFrame:
    """Accuracy / class mean of each part, mean and standard error over seeds."""
    means, lines = averages.set_index(["cell", "part"]), []
    for cell, title in TITLES.items():
        if (cell, "dev") not in means.index:
            continue  # its runs are still to be made
        line = {"learnt from": title}
        for part, name in NAMES.items():
            scores = means.loc[(cell, part)]
            both = (scores[score] for score in ("accuracy", "class_mean_accuracy"))
            line[name] = " / ".join(mean.format(count=False) for mean in both)
        lines.append(line | {"seeds": len(means.loc[(cell, "dev")]["seeds"])})
    return pd.DataFrame(lines)


def differences(bits, blocks: np.ndarray, part: str, pairs, means) -> pd.DataFrame:
    """Lines of pairs; the class mean's is the mean over their seeds, without an interval."""
    lines = []
    for first, second in pairs:
        seeds = [
            seed for seed in range(9) if {(part, c, seed) for c in (first, second)} <= set(bits)
        ]
        if seeds:
            both = [
                np.stack([bits[part, cell, seed] for seed in seeds]) for cell in (first, second)
            ]
            value = bootstrap_difference(*both, blocks)
            mean = np.mean([means[first, seed] - means[second, seed] for seed in seeds])
            line = {"first": first, "second": second, "difference": value.format()}
            lines.append(line | {"class mean": f"{100 * mean:+.1f}"})
    return pd.DataFrame(lines)


def round_table(records: list[RunRecord]) -> pd.DataFrame:
    lines = []
    for record in records:
        cell, part = place(record)
        if part == "dev" and record.seed == 0:
            for round_ in record.rounds:
                kept, right = round_["kept"], round_.get("right")
                lines.append(
                    {
                        "cell": cell,
                        "round": round_["round"],
                        "θ": f"{round_['theta']:.3f}",
                        "confident": sum(round_["confident"]),
                        "kept": sum(kept),
                        "right of them": "–" if right is None else sum(right),
                        "kept by class": " ".join(map(str, kept)),
                        "right by class": "–" if right is None else " ".join(map(str, right)),
                    }
                )
    return pd.DataFrame(lines)


def confusion(records: list[RunRecord], cell: str, part: str) -> list[str]:
    """Lines of the confusion matrix of a cell, summed over its seeds."""
    mine = [record.scores for record in records if place(record) == (cell, part)]
    if not mine:
        return []
    counts = np.sum([scores.confusion for scores in mine], axis=0)[:, : len(mine[0].class_names)]
    names = mine[0].class_names
    table = pd.DataFrame(counts, columns=[name[:4] for name in names]).astype(object)
    table.insert(0, "true", names)
    head = f"## Answers of {cell} on {NAMES[part]}, {len(mine)} seeds together"
    return [head, "", to_markdown(table), ""]


def fill(page: str, name: str, table: str) -> str:
    """Put a table between its marks in a page, if it has them."""
    begin, end = f"<!-- real: {name} -->\n", "<!-- real: end -->"
    head, mark, rest = page.partition(begin)
    if not mark:
        return page
    return head + begin + "\n" + table + "\n\n" + rest[rest.index(end) :]


def filled(page: str, text: str) -> str:
    """Return a page of the documentation with its tables anew, out of what `tables` returned."""
    heads = {"short": SHORT, "scores": SCORES}
    starts = {name: f"{head}\n\n" for name, head in heads.items()}
    starts |= {"differences": "over both.\n\n", "switches": "one at a time:\n\n"}
    for name, start in starts.items():
        page = fill(page, name, text.partition(start)[2].partition("\n\n")[0])
    return page


def draw_mended(out: Path, shared: Path, path: Path) -> None:
    """Draw objects that two runs of seed 0 answer differently, evenly spaced in the filming."""
    clouds, answers = parts(shared)["dev"], []
    for cell in ("rooms", "rooms QBST average"):
        answers.append(
            predict_probabilities(load_model(out / f"{cell}-0"), clouds.points).argmax(axis=1)
        )
    right = [answer == clouds.labels for answer in answers]
    figure = Figure(figsize=(14, 6.6), layout="constrained")
    spots = iter(figure.subplots(4, 5).flat)
    for name, rows in (("mended", right[1] & ~right[0]), ("broken", right[0] & ~right[1])):
        found = np.flatnonzero(rows)
        for row in found[np.linspace(0, len(found) - 1, 10).astype(int)]:
            spot, labels = next(spots), (clouds.labels[row], answers[0][row], answers[1][row])
            draw_cloud(spot, np.asarray(clouds.points[row], np.float64), 30.0, 20.0)
            true, before, after = (clouds.class_names[label] for label in labels)
            spot.set_title(f"{name}: {true}\n{before} → {after}", fontsize=9)
            spot.set_axis_off()
    figure.savefig(path, dpi=80)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=Path, default=Path("results/real"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--shared", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    if options.out:
        note_right(options.out, options.shared, options.records)
        if options.picture:
            draw_mended(options.out, options.shared, options.picture)
    text = tables(options.records)
    (options.records / TABLES).write_text(text)
    for path in PAGES:
        path.write_text(filled(path.read_text(), text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
