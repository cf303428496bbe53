"""One update against torch's own pieces."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives.common import LossModule

from gdrl_torchrl.agents.update import Update


class Squares(LossModule):
    """The mean squared value of a network, scaled."""

    def __init__(self, scale):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
        self.unused = nn.Linear(2, 2)
        self.scale = scale
        self.out_keys = ["loss"]

    def forward(self, tensordict):
        value = self.network(tensordict["observation"])
        loss = self.scale * value.square().mean()
        return TensorDict(loss=loss, value_mean=value.detach().mean())


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


def test_diagnostics_change_nothing_and_are_means_over_what_was_diagnosed():
    torch.manual_seed(0)
    loss = Squares(1.0)
    other = copy.deepcopy(loss)
    updates = [
        Update(
            one,
            torch.optim.Adam(one.parameters(), lr=0.01),
            max_grad_norm=0.5,
            diagnostics=["value_mean"],
            noted=["priority"],
        )
        for one in (loss, other)
    ]
    assert updates[0].means.names == ("loss", "grad_norm", "value_mean", "priority")
    losses, values = [], []
    for number in range(4):
        batch = TensorDict(observation=torch.rand(8, 3), batch_size=[8])
        diagnose = number >= 2
        values.append(float(loss(batch)["value_mean"]))
        losses.append(float(updates[0](batch, diagnose=diagnose)["loss"]))
        updates[1](batch)
        for mine, its in zip(loss.parameters(), other.parameters(), strict=True):
            assert torch.equal(mine, its)
    updates[0].means.add([("priority", torch.tensor(3.0))])
    means = updates[0].means.take()
    assert means["loss"] == pytest.approx(sum(losses) / 4)
    assert means["value_mean"] == pytest.approx(sum(values[2:]) / 2)
    assert means["priority"] == 3.0
    assert updates[0].means.take() == {}
    assert updates[1].means.take().keys() == {"loss", "grad_norm"}
