"""The pages of the documentation hold together, and every command on them is one that qs3 takes."""

import ast
import dataclasses
import importlib
import json
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
import yaml
from PIL import Image

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
try:
    import hooks
    import make
finally:
    sys.path.remove(str(DOCS))

from qs3 import shapes  # noqa: E402
from qs3.adaptation import Method  # noqa: E402
from qs3.answers.answer import DOUBT  # noqa: E402

PAGES = sorted(DOCS.rglob("*.md"))
ALL = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
NAMES = [str(page.relative_to(ROOT)) for page in ALL]
MADE = {"contributing.md", "changelog.md", "examples.md"}
"""Pages that exist in the built site alone."""
SUBCOMMANDS = {"extract": ("scannet", "nyuv2", "depth")}


@cache
def text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def prose(page: Path) -> str:
    """The page without its blocks of code and its code in lines."""
    return re.sub(r"```.*?```|`[^`\n]*`", "", text(page), flags=re.DOTALL)


def leaves(nav) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    branches = nav.values() if isinstance(nav, dict) else nav
    return [leaf for branch in branches for leaf in leaves(branch)]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text(page), re.DOTALL | re.MULTILINE)


def test_nav_lists_every_page_once():
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = leaves(config["nav"])
    there = {page.relative_to(DOCS).as_posix() for page in PAGES}
    assert len(listed) == len(set(listed))
    assert set(listed) == there | MADE
    assert not MADE & there


@pytest.mark.parametrize("page", ALL, ids=NAMES)
def test_every_link_and_picture_resolves(page):
    for goal in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", goal):
            continue
        assert not goal.startswith("/"), goal
        path, _, anchor = goal.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), goal
        assert ROOT in there.parents, goal
        if anchor and there.suffix == ".md" and not anchor.startswith("qs3."):
            assert anchor in anchors(there), goal


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as both GitHub and the site make them."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text(page), flags=re.S), re.M)
    found = (re.sub(r"[^\w\s-]", "", title.lower()).strip() for title in titles)
    return {re.sub(r"[\s-]+", "-", title) for title in found}


def test_links_to_descriptions_of_code_resolve():
    count = 0
    for page in PAGES:
        for path, name in re.findall(r"\]\(([^)\s#]*)#(qs3\.[\w.]+)\)", text(page)):
            there = (page.parent / path).resolve()
            package = re.search(r"<!-- package: ([\w.]+) -->", text(there))
            assert package is not None, path
            modules = re.findall(r"^::: (\S+)$", hooks.body(package[1]), re.MULTILINE)
            module, _, last = name.rpartition(".")
            assert module in modules, name
            tree = ast.parse(text((ROOT / "src" / module.replace(".", "/")).with_suffix(".py")))
            assert last in {getattr(node, "name", None) for node in tree.body}, name
            count += 1
    assert count > 2


def test_every_public_package_has_its_page():
    marked = re.findall(
        r"<!-- package: ([\w.]+) -->", "".join(text(page) for page in (DOCS / "api").glob("*.md"))
    )
    assert sorted(marked) == sorted(hooks.PACKAGES)
    folders = {p.parent.name for p in (ROOT / "src" / "qs3").glob("[!_]*/__init__.py")} - {"cli"}
    assert {f"qs3.{name}" for name in folders} | {"qs3"} == set(hooks.PACKAGES)
    body = hooks.body("qs3.training")
    assert "[`fit`](#qs3.training.fitting.fit)" in body
    assert "\n::: qs3.training.fitting\n" in body
    assert "[`scan`](sensor.md#qs3.sensor.scan.scan)" in hooks.body("qs3")


ASK = """
import json, hooks
from qs3.cli import VERBS
verbs = list(VERBS)
asked = [verb for verb in verbs if verb != "extract"]
asked += [f"extract {name}" for name in ("scannet", "nyuv2", "depth")]
printed = {v: hooks.options_of(hooks.help_of(v.split())) for v in asked}
try:
    refused = hooks.options_table(["no-such-verb"])
except ValueError as error:
    refused = str(error)
table = hooks.options_table(["info"])
print(json.dumps({"verbs": verbs, "options": printed, "table": table, "refused": refused}))
"""


@cache
def printed() -> dict:
    """What the commands say of themselves.

    In a process of its own: tyro hands its mark of a missing value to settings, which the checks of
    types in tests refuse.
    """
    done = subprocess.run(
        [sys.executable, "-c", ASK], cwd=DOCS, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def options(verb: str) -> set[str]:
    """Options that a verb takes, by all names of each."""
    rows = printed()["options"][verb]
    assert rows, verb
    return {name for flag, _ in rows for name in re.findall(r"(?<![\w-])--[\w.-]+", flag)}


def verbs() -> list[str]:
    return printed()["verbs"]


def commands(page: Path) -> list[str]:
    """Commands in blocks of shell and in indented ones, continued lines joined."""
    code = "".join(blocks(page, "sh"))
    code += "".join(f"{line}\n" for line in re.findall(r"^ {4}(qs3 .*)$", prose(page), re.M))
    joined = code.replace("\\\n", " ")
    return [
        found[1]
        for line in joined.splitlines()
        if (found := re.match(r"\s*(?:[A-Z0-9_]+=\S+ )*qs3 (.+?)(?:\s[#|>;&]| {4}|$)", line))
    ]


@pytest.mark.parametrize("page", ALL, ids=NAMES)
def test_commands_name_verbs_and_options_that_exist(page):
    for command in commands(page):
        verb, *words = shlex.split(command)
        assert verb in verbs(), command
        if verb in SUBCOMMANDS and words and not words[0].startswith("-"):
            assert words[0] in SUBCOMMANDS[verb], command
            verb = f"{verb} {words[0]}"
        for word in (word.strip("[]") for word in words):
            if word.startswith("--"):
                name = word.partition("=")[0]
                assert name in options(verb) or name == "--help", f"{command}: {word}"


def test_the_check_of_commands_sees_commands():
    assert len(commands(ROOT / "README.md")) > 10
    assert len(commands(DOCS / "commands.md")) >= len(verbs())
    assert "--no-such-option" not in options("train")
    assert "--self-training.rounds" in options("train")


SCANS = sorted(
    {c for page in ALL for c in commands(page) if c.startswith("scan ") and "cycles" not in c}
)


@pytest.mark.slow
@pytest.mark.parametrize("command", SCANS)
def test_scans_of_the_pages_run_as_written(command, tmp_path):
    qs3 = [sys.executable, "-m", "qs3"]
    sensor = subprocess.run([*qs3, "sensors", "show", "d435"], capture_output=True, check=True)
    (tmp_path / "my_camera.toml").write_bytes(sensor.stdout)
    (tmp_path / "my_part.obj").write_text(shapes.make("chair", seed=0).export(file_type="obj"))
    words = shlex.split(command)
    subprocess.run([*qs3, *words, "--num-points", "64"], cwd=tmp_path, check=True)
    assert (tmp_path / words[words.index("--out") + 1] / "cloud.ply").is_file()


def test_the_page_of_commands_lists_exactly_the_verbs():
    page = text(DOCS / "commands.md")
    listed = re.findall(r"^### (\S+)$", page, re.MULTILINE)
    assert set(listed) == set(verbs())
    assert len(listed) == len(set(listed))
    for verb in listed:
        part = page.split(f"\n### {verb}\n")[1].split("\n#")[0]
        assert f"\nqs3 {verb}" in part
        folded = re.findall(r"^<!-- options: (.+) -->$", part, re.MULTILINE)
        if verb in SUBCOMMANDS:
            assert folded == [f"{verb} {more}" for more in SUBCOMMANDS[verb]]
        else:
            assert folded == ([verb] if printed()["options"][verb] else [])


@pytest.mark.parametrize("page", ALL, ids=NAMES)
def test_python_on_the_pages_compiles(page):
    for code in blocks(page, "python"):
        compile(code, str(page), "exec")


def test_the_picture_of_the_sensors_is_of_the_presets_as_they_are():
    """Else `python docs/make.py sensor` draws it anew."""
    with Image.open(make.SENSOR_PICTURE) as picture:
        assert picture.info["presets"] == make.presets()


DESCRIBED = sorted(
    {name for page in PAGES for name in re.findall(r"^<!-- settings: (\S+) -->$", text(page), re.M)}
)


@pytest.mark.parametrize("name", DESCRIBED)
def test_a_table_of_settings_has_each_field_in_order_with_its_meaning(name):
    module, _, last = name.rpartition(".")
    kind = getattr(importlib.import_module(module), last)
    general = {field.name for field in dataclasses.fields(Method)}
    names = [field.name for field in dataclasses.fields(kind) if field.name not in general]
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| \S.+ \|$", hooks.settings_table(name), re.M)
    assert rows == names != []


def test_tables_of_presets_are_where_the_paper_and_its_code_differ():
    rounds, scans = hooks.presets_table("rounds"), hooks.presets_table("scans")
    assert "| `pool` | all | all | all | shrinking | split |" in rounds
    assert "`step`" not in rounds
    assert "| `size` | box | ball | box |" in scans
    assert "| `redraw` | on | off | off |" in scans


def test_published_figures_of_the_methods_are_those_of_the_table():
    with (ROOT / "src/qs3/paper/published.toml").open("rb") as file:
        table = tomllib.load(file)

    def pairs(node) -> set[tuple[float, float]]:
        if isinstance(node, dict):
            return {pair for value in node.values() for pair in pairs(value)}
        if isinstance(node, list) and len(node) == 2 and isinstance(node[0], float):
            return {(node[0], node[1])}
        return (
            {pair for value in node for pair in pairs(value)} if isinstance(node, list) else set()
        )

    known = pairs(table)
    printed = [
        (float(mean), float(error))
        for mean, error in re.findall(r"(\d+\.\d) ± (\d+\.\d)", text(DOCS / "methods.md"))
    ]
    assert len(printed) >= 20
    assert set(printed) <= known


@pytest.mark.parametrize(
    ("name", "page"),
    [
        ("parts/parts.md", "own-parts.md"),
        ("parts/adapt.md", "own-parts.md"),
        ("parts/reliability.md", "own-parts.md"),
        ("table-parts/table.md", "own-parts.md"),
        ("demo/demo.md", "start.md"),
        ("scenes/scenes.md", "live.md"),
        ("scenes/others.md", "live.md"),
        ("scenes/cad.md", "live.md"),
        ("scenes/times.md", "live.md"),
        ("scenes/stereo.md", "live.md"),
    ],
)
def test_tables_of_parts_are_those_of_the_benchmarks(name, page):
    """Else `python docs/make.py own-parts` shows them anew."""
    _, rest = text(DOCS / page).split(f"<!-- table: results/{name} -->\n\n")
    shown, _ = rest.split(f"\n<!-- end of results/{name} -->")
    assert shown == text(DOCS.parent / "results" / name)


def test_the_share_of_right_answers_above_the_limit_of_doubt_is_that_of_the_table():
    (row,) = re.findall(
        rf"^\| {DOUBT} to 0\.7 \|.*", text(DOCS.parent / "results/parts/reliability.md"), re.M
    )
    _, clouds, _, real, scans, _, simulated = row.strip("| ").split(" | ")
    page = " ".join(text(DOCS / "own-parts.md").split())
    assert f"*in doubt*: a confidence below {DOUBT}, or *lost*" in page
    shares = f"{real} % of {clouds} were right on real machine parts and {simulated} % of {scans}"
    assert shares in page


def test_the_readme_shows_the_median_of_the_demo():
    _, readme = text(DOCS.parent / "README.md").split("| answered by |")
    shown = [line.split(" | ")[1].split()[0] for line in readme.splitlines()[2:7]]
    record = text(DOCS.parent / "results" / "demo" / "demo.md").splitlines()
    assert shown == [line.split("|")[-2].strip() for line in record[2:]]


def test_examples_are_shown_whole():
    page = hooks.examples()
    for path in (ROOT / "examples").glob("*.py"):
        assert path.read_text(encoding="utf-8") in page
