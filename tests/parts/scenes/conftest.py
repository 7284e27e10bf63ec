import pytest

from qs3.parts import Library

from ...stores import view_once
from .tables import PARTS


@pytest.fixture(scope="session")
def library() -> Library:
    return Library(tuple(view_once(mesh, 1.0, name, name) for name, mesh in PARTS.items()))
