import pytest

from ..stores import make_once


@pytest.fixture(scope="module", autouse=True)
def looked_at_once():
    with pytest.MonkeyPatch.context() as patch:
        make_once(patch)
        yield
