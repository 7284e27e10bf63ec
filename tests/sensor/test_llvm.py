"""The LLVM that Mitsuba's fast CPU variant loads: which library, and the same bits from each."""

import importlib.metadata
import os
from pathlib import PurePosixPath

import pytest

from qs3.sensor.light import mitsuba as llvm


@pytest.fixture(autouse=True)
def forget(monkeypatch):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "")  # put back after the test, whatever it sets
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH")
    llvm.find_llvm.cache_clear()
    yield
    llvm.find_llvm.cache_clear()


class _File(PurePosixPath):
    def locate(self):
        return self


@pytest.mark.parametrize(
    ("variable", "system", "wheel", "found"),
    [
        ("/opt/libLLVM.so", None, True, "/opt/libLLVM.so"),
        ("", "libLLVM-19.so", True, None),
        ("", None, True, "libLLVM.so.19.1"),
        ("", None, False, None),  # listed, but deleted: Dr.Jit searches itself
    ],
)
def test_variable_comes_before_the_systems_19_and_that_before_the_wheel(
    monkeypatch, tmp_path, variable, system, wheel, found
):
    path = tmp_path / "libLLVM.so.19.1"
    if wheel:
        path.touch()
    if variable:
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", variable)
    monkeypatch.setattr(llvm.ctypes.util, "find_library", lambda name: system)
    files = [_File(tmp_path / "libLTO.so.19.1"), _File(path)]
    monkeypatch.setattr(importlib.metadata, "files", lambda name: files)
    wanted = str(path) if found == path.name else found
    assert llvm.find_llvm() == wanted
    llvm.point_to_llvm()
    assert os.environ.get("DRJIT_LIBLLVM_PATH") == wanted  # for this process and its children


def test_without_wheel_and_system_dr_jit_searches_itself(monkeypatch):
    def none(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(llvm.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(importlib.metadata, "files", none)
    assert llvm.find_llvm() is None
