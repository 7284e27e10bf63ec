"""The pages on adaptation and settings say what the code does."""

import dataclasses
import functools
import inspect
import json
import re
import shlex
from pathlib import Path
from typing import get_args

import pytest
import torch
import tyro

from qs3.adaptation import create_method, method_class
from qs3.adaptation.method import Batch
from qs3.adaptation.names import COMPOSED, MethodName, RoundRule, Rule, split_method
from qs3.cli.evaluate import evaluate_run
from qs3.cli.train import TrainOptions, parse_settings
from qs3.io.preparation import PAPER, ROBUST, Preparation
from qs3.models import create_model
from qs3.training import PRESETS, SelfTrainingSettings, TrainSettings

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "adaptation.md").read_text(encoding="utf-8")
SETTINGS = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
METHODS = get_args(MethodName)
ON = {"on": True, "off": False}


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
        for title, text in sections(PAGE, 3).items()
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
    assert tuple(rows(PAGE, *head)) == METHODS


@pytest.mark.parametrize("name", METHODS)
def test_settings_of_a_method_are_those_of_its_class(name):
    text = of_methods()[name]
    if name in COMPOSED:
        assert all(f"`{part}`" in text for part in COMPOSED[name])
        assert "| setting |" not in text
        return
    fixed = {"self", "model", "label_smoothing"}
    kind = method_class(name)
    own = {
        key: parameter.default
        for key, parameter in inspect.signature(kind.__init__).parameters.items()
        if key not in fixed
    }
    if not own:
        assert "No settings" in text
        return
    table = rows(text, "setting", "default", "meaning")
    assert list(table) == list(own)
    for key, default in own.items():
        # As --method-set reads it.
        read = parse_settings("--method-set", [f"{key}={table[key][0]}"])[key]
        assert read == json.loads(json.dumps(default)), key
        assert type(read) is type(default) or not isinstance(default, (bool, str)), key
    # Deviations that the class notes must be on the page.
    assert ("NOTE" in (kind.__doc__ or "")) == bool(re.search(r"^Differs", text, re.MULTILINE))


@pytest.mark.parametrize("name", METHODS)
def test_needs_passes_and_weights_of_a_method(name, monkeypatch):
    _, _, needs, passes, weights = rows(
        PAGE, "method", "paper", "idea", "needs", "passes", "weights, M"
    )[name]
    base, rule = split_method(name)
    kind = method_class(base)
    assert ("target" in needs) == (kind.uses_target or rule is not None)
    assert ("local features" in needs) == kind.needs_local
    assert ("then 2" in passes) == (rule is not None)
    model = create_model("dgcnn", 10)
    own = sum(p.numel() for p in model.parameters())
    more = sum(p.numel() for p in create_method(base, model).parameters()) - own
    assert float(weights) == round(more / 1e6, 2)
    assert f"{own / 1e6:.2f} M" in PAGE
    made = create_method(base, small())
    passed = []
    network = type(made.model)
    encode = network.encode

    def counted(self, points):
        passed.append(len(points))
        return encode(self, points)

    monkeypatch.setattr(network, "encode", counted)
    clouds = torch.rand(4, 24, 3, generator=torch.Generator().manual_seed(0))
    batch = Batch(clouds, torch.arange(4) % 3)
    made(batch, clouds if kind.uses_target else None, 0.5, torch.Generator().manual_seed(0))
    assert len(passed) == int(passes.split(",")[0])


@pytest.mark.parametrize(("verb", "words"), [*commands(PAGE), *commands(README)])
def test_commands_of_the_pages_parse_and_fit_together(verb, words):
    if verb == "evaluate":
        tyro.cli(functools.wraps(evaluate_run)(lambda *_, **__: 0), args=words)
        return
    options = tyro.cli(TrainOptions, args=words)
    base, rule = split_method(options.method, options.rounds_rule)
    network = options.train.model
    model = create_model(network, 3, **parse_settings("--model-set", options.model_set))
    kind = method_class(base)
    create_method(base, model, **parse_settings("--method-set", options.method_set))
    assert options.target is not None or not (kind.uses_target or rule)
    assert rule is not None or (
        options.warm_up is None and options.self_training == SelfTrainingSettings()
    )


def test_the_pages_hold_the_commands_that_are_tested():
    assert len(commands(PAGE)) >= 8
    assert any("--method" in words for _, words in commands(README))
    assert "docs/adaptation.md" in README


@pytest.mark.parametrize("page", [PAGE, SETTINGS], ids=["adaptation", "settings"])
def test_every_flag_that_is_named_exists(page, typed):
    help_text = "".join(typed(verb, "--help").stdout for verb in ("train", "evaluate"))
    known = set(re.findall(r"--[a-z.-]+", help_text))
    known |= {flag.replace("no-", "") for flag in known} | {"--crop"}
    for flag in re.findall(r"(?<![\w-])--[a-z][a-z.-]*(?<![.-])", page):
        assert flag in known, flag


def test_tables_of_rules_name_all_of_them():
    assert list(rows(PAGE, "rule", "kept of class k", "where from")) == list(get_args(RoundRule))
    assert list(rows(PAGE, "rule", "keeps", "needs")) == list(get_args(Rule))
    assert list(rows(PAGE, "preset", "what differs from `default`")) == [
        name for name in PRESETS if name != "default"
    ]


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_presets_on_the_page(preset):
    differs = rows(PAGE, "preset", "what differs from `default`")[preset][0].split(" unless ")[0]
    default, chosen = PRESETS["default"], PRESETS[preset]
    for field in dataclasses.fields(SelfTrainingSettings):
        value, name = getattr(chosen, field.name), field.name
        words = f"{name}|{name.replace('_', ' ')}"
        named = re.search(rf"(?<!\w)({words})\b", differs) is not None
        assert named == (value != getattr(default, name)), name
        if named and isinstance(value, bool):
            assert f"no {name.replace('_', ' ')}" in differs or value, name
        elif named:
            assert re.search(rf"\b{name}` ?`?{value}|{name} `{value}`", differs), name


def value_of(cell, like):
    """What a cell of the settings page says; words after the first explain it."""
    word = re.split(r"[\s:,;]", cell)[0].strip("`")
    if isinstance(like, bool):
        return ON[word]
    if like is None:
        assert word in ("none", "off")
        return None
    return type(like)(word)


def test_settings_of_self_training():
    text = sections(SETTINGS, 3)["Self-training"]
    table = rows(text, "setting", "default", "`spst`", "what it does")
    names = [field.name for field in dataclasses.fields(SelfTrainingSettings)]
    assert list(table) == names
    for name in names:
        for cell, preset in zip(table[name], ("default", "spst"), strict=False):
            value = getattr(PRESETS[preset], name)
            assert value_of(cell, value) == value, (name, preset)


def test_settings_of_the_preparation():
    title = "Preparation: from a cloud to what a network takes"
    table = rows(sections(SETTINGS, 3)[title], "setting", "default", "paper", "what it does")
    fields = [field.name for field in dataclasses.fields(Preparation)]
    assert [row.removeprefix("--").replace("-", "_") for row in table] == fields
    for name, cells in zip(fields, table.values(), strict=True):
        for cell, preparation in zip(cells, (ROBUST, PAPER), strict=False):
            value = getattr(preparation, name)
            assert value_of(cell, value) == value, name


def test_columns_where_text_and_code_differ():
    table = rows(SETTINGS, "setting", "qs3", "`paper`", "`released`")
    names = {field.name for field in dataclasses.fields(SelfTrainingSettings)}
    seen = set()
    for row, cells in table.items():
        name = re.match(r"\w+", row)[0]
        if name not in names:
            continue
        seen.add(name)
        for cell, preset in zip(cells, ("default", "paper", "released"), strict=True):
            value = getattr(PRESETS[preset], name)
            assert value_of(cell, value) == value, (name, preset)
    differing = {
        name
        for name in names
        for preset in ("paper", "released")
        if getattr(PRESETS[preset], name) != getattr(PRESETS["default"], name)
    }
    assert differing == seen


def test_settings_of_training():
    table = rows(sections(SETTINGS, 2)["Training"], "setting", "default", "what it does")
    fields = {field.name for field in dataclasses.fields(TrainSettings)}
    new = {"holdout", "validate_every", "rule", "model_set", "method_set"}
    names = {row.removeprefix("--").replace("-", "_"): cells for row, cells in table.items()}
    assert new <= set(names)
    for name in fields & set(names):
        default = getattr(TrainSettings(), name)
        assert value_of(names[name][0], default) == default, name


@pytest.mark.parametrize("code", re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL))
def test_python_on_the_page_runs(code):
    exec(compile(code, "docs/adaptation.md", "exec"), {})  # noqa: S102
