"""Ctrl-C at any moment ends in KeyboardInterrupt, and so in exit code 130."""

import signal

import numpy as np
import pytest

from qs3.cli import interrupt
from qs3.points.compiled import compiled


def _sums(points):
    return points + 1.0, points.sum(), points * 2.0


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers of POSIX")
def test_ctrl_c_while_compiled_code_packs_its_result():
    sums, points = compiled(_sums), np.ones(1)
    sums(points)
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for number in range(100):
            with pytest.raises(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, 1e-3 + 1e-5 * number)
                while True:
                    sums(points)
    finally:
        signal.signal(signal.SIGALRM, before)
