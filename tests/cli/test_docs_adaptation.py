"""The pages on adaptation and settings say what the code does."""

import functools
import re
import shlex
from pathlib import Path
from typing import get_args

import pytest
import torch
import tyro

from qs3.adaptation import create_method, method_class
from qs3.adaptation.method import Batch
from qs3.adaptation.names import COMPOSED, RoundRule, Rule, split_method
from qs3.cli.evaluate import evaluate
from qs3.cli.options import REGISTRY
from qs3.cli.train import TrainOptions, parse_settings
from qs3.models import create_model
from qs3.paper.names import MethodName
from qs3.runs import SelfTrainingSettings

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "adaptation.md").read_text(encoding="utf-8")
METHOD_PAGE = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
SETTINGS = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
METHODS = get_args(MethodName)


def sections(page, level):
    """Text below each heading of a level, by its title."""
    parts = re.split(rf"^{'#' * level} (.+)$", page, flags=re.MULTILINE)
    return {
        title: re.split(rf"^#{{2,{level}}} ", text, flags=re.MULTILINE)[0]
        for title, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def rows(text, *head):
    """Cells of the table that has this head, without backticks around the first."""
    line = "| " + " | ".join(head) + " |"
    assert text.count(line) == 1, line
    body = text.split(line)[1].split("\n")[2:]
    cells_of = {}
    for row in body:
        if not row.startswith("|"):
            break
        name, *cells = [cell.strip() for cell in row.strip().strip("|").split("|")]
        assert name not in cells_of
        cells_of[name.strip("`")] = cells
    return cells_of


def of_methods():
    """Section of each method; a heading may name several."""
    return {
        name: text
        for title, text in sections(METHOD_PAGE, 2).items()
        for name in re.findall(r"`([a-z0-9-]+)`", title)
    }


def commands(page):
    """Words of each command of a verb that trains or scores, continued lines joined."""
    text = page.replace("\\\n", " ")
    lines = re.findall(r"^(?:    )?qs3 (train|evaluate) ([^#\n]*)", text, flags=re.MULTILINE)
    return [(verb, tuple(shlex.split(words))) for verb, words in lines]


def small():
    return create_model("pointnet", 3, channels=(8, 8, 16), hidden=(16, 8), transforms=False)


def test_every_method_has_a_section_and_a_row():
    assert set(of_methods()) == set(METHODS)
    head = ("method", "paper", "idea", "needs", "passes", "weights, M")
    assert tuple(rows(METHOD_PAGE, *head)) == METHODS


def test_methods_that_deviate_from_their_paper_say_so():
    for name in set(METHODS) - COMPOSED.keys():
        deviates = "NOTE" in (method_class(name).__doc__ or "")
        assert deviates == bool(re.search(r"^Differs", of_methods()[name], re.MULTILINE)), name


@pytest.mark.parametrize("name", METHODS)
def test_needs_passes_and_weights_of_a_method(name, monkeypatch):
    _, _, needs, passes, weights = rows(
        METHOD_PAGE, "method", "paper", "idea", "needs", "passes", "weights, M"
    )[name]
    base, rule = split_method(name)
    kind = method_class(base)
    assert ("target" in needs) == (kind.uses_target or rule is not None)
    assert ("local features" in needs) == kind.needs_local
    assert ("then 2" in passes) == (rule is not None)
    model = create_model("dgcnn", 10)
    size = sum(p.numel() for p in model.parameters())
    more = sum(p.numel() for p in create_method(base, model).parameters()) - size
    assert float(weights) == round(more / 1e6, 2)
    assert f"{size / 1e6:.2f} M" in METHOD_PAGE
    learner = create_method(base, small())
    passed = []
    network = type(learner.model)
    encode = network.encode

    def counted(self, points):
        passed.append(len(points))
        return encode(self, points)

    monkeypatch.setattr(network, "encode", counted)
    clouds = torch.rand(4, 24, 3, generator=torch.Generator().manual_seed(0))
    batch = Batch(clouds, torch.arange(4) % 3)
    learner(batch, clouds if kind.uses_target else None, 0.5, torch.Generator().manual_seed(0))
    assert len(passed) == int(passes.split(",")[0])


COMMANDS = [command for page in (PAGE, METHOD_PAGE, README) for command in commands(page)]


@pytest.mark.parametrize(("verb", "words"), COMMANDS)
def test_commands_of_the_pages_parse_and_fit_together(verb, words):
    if verb == "evaluate":
        tyro.cli(functools.wraps(evaluate)(lambda *_, **__: 0), registry=REGISTRY, args=words)
        return
    options = tyro.cli(TrainOptions, registry=REGISTRY, args=words)
    base, rule = split_method(options.method, options.rounds_rule)
    network = options.train.model
    model = create_model(network, 3, **parse_settings("--model-set", options.model_set))
    kind = method_class(base)
    create_method(base, model, **parse_settings("--method-set", options.method_set))
    assert options.target is not None or not (kind.uses_target or rule)
    assert rule is not None or (
        options.warm_up is None and options.self_training == SelfTrainingSettings()
    )


@pytest.mark.parametrize(
    "page", [PAGE, METHOD_PAGE, SETTINGS], ids=["adaptation", "methods", "settings"]
)
def test_every_flag_that_is_named_exists(page, typed):
    help_text = "".join(typed(verb, "--help").stdout for verb in ("generate", "train", "evaluate"))
    known = set(re.findall(r"--[a-z.-]+", help_text))
    known |= {flag.replace("no-", "") for flag in known}
    for flag in re.findall(r"(?<![\w-])--[a-z][a-z.-]*(?<![.-])", page):
        assert flag in known, flag


def test_tables_of_rules_name_all_of_them():
    assert list(rows(PAGE, "rule", "kept of class k", "source")) == list(get_args(RoundRule))
    assert list(rows(PAGE, "rule", "keeps", "needs")) == list(get_args(Rule))


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL))
def test_python_on_the_page_runs(code):
    exec(compile(code, "docs/adaptation.md", "exec"), {})  # noqa: S102
