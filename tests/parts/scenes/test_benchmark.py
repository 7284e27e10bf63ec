"""The bench of scenes scores the parts that it was asked for."""

from pathlib import Path

import pytest

from ...scripts import load_script

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # the script sets it for good
    monkeypatch.syspath_prepend(BENCHMARKS)
    return load_script(BENCHMARKS / "scenes.py")


def test_scenes_of_other_parts_are_not_scored(bench, tmp_path, monkeypatch) -> None:
    solids, cad = bench.solids(bench.CHOSEN, None), tmp_path / "out" / "cad"
    bench.keep_cad(cad, solids)
    held = {path.name: path.read_bytes() for path in cad.iterdir()}
    assert sorted(held) == sorted(f"{name}.stl" for name in solids)
    bench.keep_cad(cad, solids)  # the same scenes again
    fewer = {name: mesh for name, mesh in solids.items() if name != "gear"}
    for others in (bench.solids(bench.OTHERS, None), fewer):
        with pytest.raises(SystemExit, match=r"holds other CAD.*name another --out"):
            bench.keep_cad(cad, others)
    monkeypatch.setattr("sys.argv", ["scenes.py", "--out", str(tmp_path / "out"), "--others"])
    with pytest.raises(SystemExit, match="holds other CAD"):
        bench.main()
    assert {path.name: path.read_bytes() for path in cad.iterdir()} == held
