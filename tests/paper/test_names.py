"""Nothing below the paper's room reaches it: neither by an import nor by a name."""

import ast
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import qs3
from qs3.adaptation import list_methods, method_class, method_name
from qs3.errors import InputError
from qs3.models import create_model, list_models
from qs3.paper.names import MethodName
from qs3.paper.rivals.gast import GAST
from qs3.runs import save_model
from qs3.training import fit

from ..models.common import SMALL

SOURCE = Path(qs3.__file__).parent
ABOVE = ("paper", "cli", "__init__.py")
BELOW = [p for p in SOURCE.rglob("*.py") if p.relative_to(SOURCE).parts[0] not in ABOVE]
# Trains, saves, loads and answers with every network and method that is known without the paper.
WITHOUT = """
import sys
class Wall:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("qs3.paper"):
            raise AssertionError(f"{name} was imported from below")
sys.meta_path.insert(0, Wall())
import numpy as np, qs3
from pathlib import Path
from qs3.adaptation import create_method
from qs3.adaptation.names import METHODS
from qs3.clouds.types import PointClouds
from qs3.models import create_model
from qs3.models.factory import MODELS
from qs3.runs import SelfTrainingSettings, TrainSettings
from qs3.training import fit
assert {*MODELS} == {"dgcnn", "pointnet", "pointnet2"}, MODELS
assert {*METHODS} == {"source-only"}, METHODS
for model in MODELS:
    for method in METHODS:
        create_method(method, create_model(model, 3))
points = np.random.default_rng(0).random((8, 32, 3), dtype=np.float32)
source = PointClouds(points, np.arange(8) % 2, ("a", "b"), tuple("abcdefgh"))
small = {"channels": (4, 4, 8), "hidden": (8, 4)}
settings = TrainSettings("pointnet", small, num_points=16, epochs=1, batch_size=4, threads=1)
rounds = SelfTrainingSettings(rounds=1, epochs=1, threshold=0.0)
fit("qbst", source, source.without_labels(), settings, rounds, run_dir=Path("run"))
assert qs3.load("run").predict_proba(points).shape == (8, 2)
"""


# What takes long to import is there; of qs3 nothing is.
FORKING = """
import json, os, sys, traceback
import numpy, torch, torch._dynamo
for line in sys.stdin:
    code, folder, name, said = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        sys.argv = ["-c", name]
        for stream in (1, 2):
            os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        try:
            exec(code, {"__name__": "__main__"})
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        sys.stdout.flush()
        os._exit(0)
    print(os.waitpid(child, 0)[1], flush=True)
"""


@pytest.fixture(scope="module")
def forking():
    environment = os.environ | {"PYTHONPATH": str(SOURCE.parent)}
    command = [sys.executable, "-c", FORKING]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        yield process


@pytest.fixture
def plain(forking, tmp_path):
    """Run code in a process that has imported nothing of qs3; return what it printed."""

    def run(code, name=""):
        file = tmp_path / "said.txt"
        forking.stdin.write(json.dumps([code, str(tmp_path), name, str(file)]) + "\n")
        forking.stdin.flush()
        assert forking.stdout.readline() == "0\n", file.read_text()
        return file.read_text().strip()

    return run


def test_no_string_below_names_a_module_of_the_paper():
    assert len(BELOW) > 200
    for path in BELOW:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert "qs3.paper" not in node.value, (path, node.lineno)


def test_training_and_answers_work_if_the_paper_cannot_be_imported(plain):
    plain(WITHOUT)


# Each in a process of its own: a name that is known makes the others known.
@pytest.mark.parametrize("model", list_models())
def test_a_run_of_any_network_loads_in_plain_python(model, source, settings, plain, tmp_path):
    small = replace(settings, model=model, model_settings=SMALL[model])
    network = create_model(model, len(source.class_names), **SMALL[model])
    save_model(tmp_path / "run", network, source.class_names, small)
    code = "import qs3; qs3.load('run').save('copy'); print(qs3.load('copy').class_names)"
    assert plain(code) == str(source.class_names)


@pytest.mark.parametrize(
    "code",
    [
        "from qs3.adaptation import create_method as make; from qs3.models import create_model;"
        "make(sys.argv[1], create_model('dgcnn', 3))",
        "from qs3.adaptation import list_methods as known; assert sys.argv[1] in known(), known()",
        "from qs3.adaptation import method_name; from qs3.paper.rivals.gast import GAST;"
        "assert method_name(GAST) == sys.argv[1]",
        "from qs3.runs.settings import plan_rounds;"
        "assert plan_rounds('gast-spst', None)[0] == sys.argv[1]",
    ],
)
def test_a_rival_method_is_known_in_plain_python(code, plain):
    plain(f"import sys;{code}", "gast")


def test_every_name_of_a_method_is_known():
    for name in {*MethodName.__args__} & {*list_methods()}:
        assert method_name(method_class(name)) == name


def test_a_class_is_taken_like_its_name(source, target, settings, tmp_path):
    rooms = [tmp_path / "class", tmp_path / "name"]
    for method, run_dir in zip((GAST, "gast"), rooms, strict=True):
        fit(method, source, target.without_labels(), settings, run_dir=run_dir)
    one, two = ((folder / "model.safetensors").read_bytes() for folder in rooms)
    assert one == two
    assert '"gast"' in (rooms[0] / "settings.json").read_text()


def test_an_unknown_name_asks_for_the_package_that_brings_it():
    for make in (method_class, lambda name: create_model(name, 3)):
        with pytest.raises(InputError, match="must be imported first"):
            make("curvenet")
