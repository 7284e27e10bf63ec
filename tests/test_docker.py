"""What the Dockerfile names is there: paths, extras, the command; and .dockerignore lets it in."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
LINES = (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ").splitlines()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_what_is_copied_exists_and_is_let_in():
    copied = {name for line in LINES if line.startswith("COPY ") for name in line.split()[1:-1]}
    assert copied >= {"pyproject.toml", "src", "constraints.txt"}
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text("utf-8").splitlines()
              if line.startswith("!")}  # fmt: skip
    assert copied == let_in
    for name in copied:
        assert (ROOT / name).exists()
    # What the build of the package reads.
    assert {PROJECT["readme"], *PROJECT["license-files"]} <= copied


def test_extras_command_and_python_are_those_of_the_project():
    text = "\n".join(LINES)
    named = re.findall(r"EXTRAS=([\w,]+)", text)
    assert named
    extras = {extra for names in named for extra in names.split(",")}
    assert extras <= PROJECT["optional-dependencies"].keys()
    entry = re.search(r'^ENTRYPOINT \["(\w+)"\]$', text, re.MULTILINE)
    assert entry[1] in PROJECT["scripts"]
    version = re.search(r"^FROM python:(3\.\d+)-slim$", text, re.MULTILINE)
    assert f"Programming Language :: Python :: {version[1]}" in PROJECT["classifiers"]
    assert text.count("-c constraints.txt") == 2
