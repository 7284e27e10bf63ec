"""``qs3 sensors`` lists what there is and writes files that can be passed back."""

import pytest

from qs3.sensor.presets import SENSORS, load_sensor


def test_the_list_has_every_sensor_with_its_figures(typed):
    lines = typed("sensors").stdout.splitlines()
    assert [line.split()[0] for line in lines[1:]] == list(SENSORS)
    row = next(line for line in lines if line.startswith("d435"))
    for figure in ("848×480", "430", "0.05 m", "0.195–6 m", SENSORS["d435"].description):
        assert figure in row


@pytest.mark.parametrize("name", ["paper", "d435"])
def test_what_is_shown_can_be_passed_back(typed, tmp_path, name):
    path = tmp_path / "copy.toml"
    path.write_text(typed("sensors", "show", name).stdout)
    assert load_sensor(path) == SENSORS[name]
    assert typed("sensors", "show", path).stdout == path.read_text()


def test_faults_are_one_line(typed):
    assert "d435" in typed.refuses("sensors", "show", "d345")
    assert "name one of" in typed.refuses("sensors", "show")
    assert "show d435" in typed.refuses("sensors", "list", "d435")
