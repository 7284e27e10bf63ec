import pytest

from qs3.runs import TrainSettings

from .common import TRAIN, make_clouds


@pytest.fixture(scope="session")
def source():
    return make_clouds()


@pytest.fixture(scope="session")
def target():
    return make_clouds(count=30, seed=1, noise=0.1)


@pytest.fixture(scope="session")
def settings():
    return TrainSettings(model="pointnet", holdout=0.0, **TRAIN)
