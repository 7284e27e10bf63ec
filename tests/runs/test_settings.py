import math
import subprocess
import sys

import pytest
import tyro

from qs3.cli.options import REGISTRY
from qs3.errors import InputError
from qs3.runs import SelfTrainingSettings, TrainSettings


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SelfTrainingSettings(threshold=1.5), "threshold 1.5 must be at least 0"),
        (lambda: SelfTrainingSettings(threshold=0.9, step=0.02), "step 0.02 takes θ above 1"),
        (lambda: SelfTrainingSettings(weight_step=0.02), "weight_step 0.02 takes the weight"),
        (
            lambda: SelfTrainingSettings(rule="spst", selection="least-confident"),
            "selection least-confident is read with rule qbst only; leave it out with rule spst",
        ),
        (lambda: SelfTrainingSettings(threshold_share=0.0), "threshold_share 0.0 must be above"),
        (
            lambda: SelfTrainingSettings(threshold_share=0.5, threshold=0.7),
            "threshold 0.7 is read with threshold_share None only; leave it out",
        ),
        (
            lambda: SelfTrainingSettings(teacher="average", init="scratch"),
            "teacher average needs init warm-up",
        ),
        (lambda: TrainSettings(rule="source-val", validate_every=0), "leaves no checkpoint"),
        (lambda: TrainSettings(batch_size=1), "batch_size 1 must be at least 2"),
        (lambda: TrainSettings(num_points=99999), "99999 must be .* at most 16384"),
        (lambda: TrainSettings(weight_decay=math.inf), "weight_decay inf"),
    ],
)
def test_faults_name_the_setting(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_unknown_words_are_refused_without_the_type_checks_of_the_tests():
    calls = {
        'TrainSettings(rule="oracle")': "no rule 'oracle'",
        'SelfTrainingSettings(pool="shrinkng")': "no pool 'shrinkng'",
        'TrainSettings(precision="half")': "no precision 'half'",
    }
    script = "from qs3.runs.settings import *\n"
    for call in calls:
        script += f"try:\n    {call}\nexcept Exception as error:\n    print(error)\n"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    for line, wanted in zip(done.stdout.splitlines(), calls.values(), strict=True):
        assert wanted in line


def test_command_line_makes_the_settings():
    options = tyro.cli(
        TrainSettings,
        registry=REGISTRY,
        args=["--model", "pointnet", "--epochs", "3", "--no-rotate-z"],
    )
    assert options == TrainSettings(model="pointnet", epochs=3, rotate_z=False)
    rounds = tyro.cli(
        SelfTrainingSettings, registry=REGISTRY, args=["--pool", "split", "--no-source-loss"]
    )
    assert rounds == SelfTrainingSettings(pool="split", source_loss=False)
