"""Networks and methods of the user's own modules, which no file may import."""

import sys
from dataclasses import replace

import pytest

from qs3.adaptation import method_class
from qs3.errors import InputError
from qs3.lazy import import_from
from qs3.models import create_model
from qs3.training import fit, load_model

from .common import same

MODULE = """
from pathlib import Path
from qs3.models import PointNet
Path("imported").touch()
class Narrow(PointNet):
    pass
"""


def test_weights_of_a_network_of_the_user_import_nothing(source, settings, tmp_path, monkeypatch):
    (tmp_path / "own_network.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    import_from("own_network:Narrow")
    chosen = replace(settings, model="own_network:Narrow")
    result = fit("source-only", source, None, chosen, run_dir=tmp_path / "run")
    assert type(result.model).__name__ == "Narrow"
    assert same(load_model(tmp_path / "run").model, result.model)
    monkeypatch.delitem(sys.modules, "own_network")
    (tmp_path / "imported").unlink()
    with pytest.raises(InputError, match=r"trust the module own_network, .*QS3_IMPORT=own_network"):
        load_model(tmp_path / "run")
    assert not (tmp_path / "imported").exists()
    import_from("own_network")
    assert same(load_model(tmp_path / "run").model, result.model)


@pytest.mark.parametrize("name", ["os:system", "os:nothing", "qs3.models.pointnet:SharedLayer"])
def test_what_is_no_network_or_method_is_never_called(name):
    for make in (method_class, lambda name: create_model(name, 3)):
        with pytest.raises(InputError, match=f"{name}: .* is no (Method|PointClassifier)"):
            make(name)


def test_a_missing_module_is_one_line(typed, monkeypatch):
    assert "no module named" in typed.refuses("train", "--method", "no_such_module:M").lower()
    monkeypatch.setenv("QS3_IMPORT", "no_such_module")
    assert "set PYTHONPATH" in typed.refuses("sensors")
