"""``qs3`` as a user types it, in the process of the tests."""

import subprocess

import pytest

from qs3.cli import main


class Typed:
    """Runs ``qs3`` in this process, which need not start; settings are checked by type here."""

    def __init__(self, capfd) -> None:
        self.capfd = capfd

    def __call__(self, *arguments, code: int = 0):
        self.capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        done = subprocess.CompletedProcess(
            arguments, int(ended.value.code or 0), *self.capfd.readouterr()
        )
        assert done.returncode == code, done.stderr
        return done

    def refuses(self, *arguments) -> str:
        return refusal(self(*arguments, code=2))


def refusal(done) -> str:
    """The one line on standard error, bars of progress aside."""
    assert done.stdout == ""
    bars = ("it/s", "scan/s", "scene/s", "cloud/s", "frame/s")
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    lines = [line for line in lines if not any(bar in line for bar in bars)]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("qs3: ")
    return lines[0]
