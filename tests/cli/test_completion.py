"""Tab completion by tyro's own script."""

import shutil
import subprocess

import pytest


def test_bash_completes_verbs_options_and_inner_verbs(qs3, tmp_path):
    if shutil.which("bash") is None:
        pytest.skip("no bash")
    script = tmp_path / "qs3.sh"
    script.write_text(qs3("--tyro-print-completion", "bash").stdout)

    def complete(*words):
        line = f'source "{script}"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _tyro_qs3'
        line += '; printf "%s\\n" "${COMPREPLY[@]}"'
        command = ["bash", "-c", line, "bash", "qs3", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    assert "train" in complete("tr")
    assert "--epochs" in complete("train", "--ep")
    assert "scannet" in complete("extract", "scan")
