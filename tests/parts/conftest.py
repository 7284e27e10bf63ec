import pytest

from ..stores import view_once


@pytest.fixture(scope="module", autouse=True)
def looked_at_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qs3.parts.library.view_of", view_once)
        yield
