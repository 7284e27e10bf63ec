"""What the tab key completes."""

import shutil
import subprocess

import pytest

from qs3.cli import VERBS


@pytest.fixture(scope="module")
def bash(qs3, tmp_path_factory):
    """The script, as bash reads it; returns what follows words."""
    if shutil.which("bash") is None:
        pytest.skip("no bash")
    script = tmp_path_factory.mktemp("shell") / "qs3.sh"
    script.write_text(qs3("completion", "bash").stdout)

    def complete(*words):
        line = f'source "{script}"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _qs3'
        line += '; printf "%s\\n" "${COMPREPLY[@]}"'
        done = subprocess.run(
            ["bash", "-c", line, "bash", "qs3", *words], capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    return complete


def test_verbs_options_and_inner_verbs_are_completed(bash):
    assert bash("") == list(VERBS)
    assert bash("tr") == ["train"]
    assert bash("train", "--self-training.ro") == ["--self-training.rounds"]
    assert bash("train", "--ep") == ["--epochs"]
    assert bash("train", "--source", "x", "--no-ro") == ["--no-rotate-z"]
    assert "--unknown" in bash("predict", "rooms", "a.ply", "--")
    assert bash("extract", "scan") == ["scannet"]
    assert "--intrinsics" in bash("extract", "depth", "--in")
    assert bash("predict", "roo") == []  # bash goes on with files
    for verb in VERBS:
        assert "--help" in bash(verb, "--h")


def test_zsh_has_the_same_behind_its_own_start(qs3):
    bash, zsh = (qs3("completion", shell).stdout for shell in ("bash", "zsh"))
    assert zsh.endswith(bash)
    assert "bashcompinit" in zsh.removesuffix(bash)
    assert "tcsh" in qs3("completion", "tcsh", code=2).stderr
