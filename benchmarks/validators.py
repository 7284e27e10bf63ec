"""Which label-free rule picks the best checkpoint? Over the records below folders of runs.

    qs3 evaluate RUN --data LABELLED --checkpoints    # of each run
    python benchmarks/validators.py RUNS

Prints, for each test set and rule, the mean regret (points that the chosen checkpoint loses against
the best one) with its standard error over the runs, and the rank correlation with the accuracy.
``oracle`` looks at the labels: by accuracy it has no regret.
"""

import argparse
import sys
from pathlib import Path

from qs3.evaluation import MeanSEM, find_records
from qs3.evaluation.regret import validator_regret
from qs3.evaluation.tables import to_markdown


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+")
    records = []
    for folder in parser.parse_args().runs:
        found, faults = find_records(folder)
        if not found:  # a folder of nothing but records, as results/real
            found, faults = find_records(folder, every_json=True)
        records += [record for _, record in found]
        for fault in faults:
            print(fault, file=sys.stderr)
    table = validator_regret(records)
    if table.empty:
        sys.exit("no run has scored checkpoints; run qs3 evaluate RUN --data DATA --checkpoints")
    table["correlation"] = [
        f"{value.mean:+.2f} (n={value.n})" if isinstance(value, MeanSEM) else "–"
        for value in table["correlation"]
    ]
    print(to_markdown(table))


if __name__ == "__main__":
    main()
