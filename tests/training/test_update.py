"""One update against torch's own pieces."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives.common import LossModule

from gdrl_torchrl.training.update import Update


class Squares(LossModule):
    """The mean squared value of a network, scaled."""

    def __init__(self, scale):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
        self.unused = nn.Linear(2, 2)
        self.scale = scale

    def forward(self, tensordict):
        value = self.network(tensordict["observation"])
        return TensorDict(loss=self.scale * value.square().mean())


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_updates_are_those_of_backward_clip_and_step(scale):
    torch.manual_seed(0)
    loss = Squares(scale)
    other = copy.deepcopy(loss)
    optimizers = [torch.optim.Adam(one.parameters(), lr=0.01) for one in (loss, other)]
    update = Update(loss, optimizers[0], max_grad_norm=0.5)
    for _ in range(3):
        batch = TensorDict(observation=torch.rand(8, 3), batch_size=[8])
        found = update(batch)
        entries = other(batch)
        optimizers[1].zero_grad()
        entries["loss"].backward()
        norm = nn.utils.clip_grad_norm_(other.parameters(), 0.5)
        optimizers[1].step()
        assert found["loss"] == entries["loss"]
        assert torch.allclose(found["grad_norm"], norm)
        assert (norm > 0.5) == (scale > 1.0), "one case is clipped, the other not"
        for mine, its in zip(loss.parameters(), other.parameters(), strict=True):
            assert torch.allclose(mine, its, rtol=1e-5, atol=1e-7)
