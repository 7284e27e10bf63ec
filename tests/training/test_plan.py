"""What a training would do is told before it is begun."""

from dataclasses import replace

from qs3.training import fit
from qs3.training.plan import describe_plan


def test_steps_are_those_of_the_training(source, target, settings, tmp_path):
    """The longer of both domains is one pass, where the method uses the target."""
    settings = replace(settings, epochs=1, validate_every=0)
    for method in ("source-only", "dann"):
        told = describe_plan(method, source, target.without_labels(), settings, None)
        done = fit(method, source, target.without_labels(), settings, run_dir=tmp_path / method)
        (epoch,) = done.history
        steps = epoch.steps
        assert told[1] == f"training  {method}, 1 epochs of {steps} steps of 8 clouds: {steps}"
