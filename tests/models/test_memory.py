"""What a training step keeps for its gradient, ours against the textbook form."""

import pytest
import torch

from qs3.models import create_model

from .common import textbook

# Share of the textbook's bytes that ours may keep. PointNet spares its widest layer alone.
SHARES = {"dgcnn": 0.25, "pointnet": 1.0, "pointnet-sa": 0.5, "pointnet2": 0.6}


def kept(model, points):
    """Bytes of all storages that wait for the backward pass, weights left out."""
    weights = {p.untyped_storage().data_ptr() for p in model.parameters()}
    storages = {}

    def note(tensor):
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        loss = model.train()(points).square().sum()
    loss.backward()
    return sum(storages.values())


@pytest.mark.parametrize("name", SHARES)
def test_less_is_kept_than_in_the_textbook_form(name):
    torch.manual_seed(0)
    points = torch.randn(2, 256, 3) * 0.4
    model = create_model(name, 10)
    ours = kept(model, points)
    theirs = kept(textbook(name).from_ours(model), points)
    assert 0 < ours <= SHARES[name] * theirs, ours / theirs
