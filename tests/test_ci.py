"""``.ci/run`` on a machine that is not its own."""

import re
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / ".ci" / "run"


@pytest.mark.skipif(not SCRIPT.is_file(), reason="not a checkout")
@pytest.mark.parametrize(("ci", "user"), [("", 0), ("true", 1000), ("false", 0), ("true", 0)])
def test_system_packages_are_installed_on_a_machine_of_ci_alone(ci, user, tmp_path):
    """Elsewhere, whoever calls it, it prints what is missing and how to install it."""
    (packages,) = re.findall(r"^packages\(\) \{\n.*?^\}\n", SCRIPT.read_text(), re.M | re.S)
    outputs = {"ldconfig": "", "id": f"echo {user}", "apt-get": 'echo "$@" >> "$0".called'}
    for name, line in outputs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "grep").symlink_to("/bin/grep")
    done = subprocess.run(
        ["/bin/bash", "-euc", f"{packages}packages"],
        env={"PATH": str(tmp_path), "CI": ci}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    called = (tmp_path / "apt-get.called").exists()
    assert called == (ci == "true" and user == 0)
    if not called:
        assert "missing" in done.stdout
        assert "apt-get install libllvm19 libusb-1.0-0 chromium" in done.stdout
