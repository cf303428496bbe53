"""Losses and gradients of a graph are those of the loss module."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import ValueOperator
from torchrl.objectives import SACLoss
from torchrl.objectives.common import LossModule

from gdrl_torchrl.agents.networks import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.agents.ppo.loss import make_ppo_loss
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.loss import RainbowLoss, resample_noise
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.fast.loss import TracedLoss

SIZE = 16


class Squares(LossModule):
    """The mean squared value of a linear network; may look at the numbers."""

    def __init__(self, looks=False):
        super().__init__()
        self.network = nn.Linear(3, 1)
        self.unused = nn.Linear(2, 2)
        self.looks = looks

    def forward(self, tensordict):
        value = self.network(tensordict["observation"])
        if self.looks and value.sum().item() > 1e9:
            value = 2 * value
        loss = value.square().mean()
        return TensorDict(loss_value=loss, other=value.detach().mean())


def rainbow(noisy=False):
    return RainbowLoss(
        make_q_actor(3, 5, value_range=(-1.0, 1.0), num_atoms=11, noisy=noisy), gamma=0.99
    )


def ppo():
    actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))
    return make_ppo_loss(actor, make_value_network(3), PPOConfig())[0]


def sac():
    actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))

    class Value(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = nn.Linear(5, 1)

        def forward(self, observation, action):
            return self.layer(torch.cat([observation, action], dim=-1))

    value = ValueOperator(Value(), in_keys=["observation", "action"])
    loss = SACLoss(actor, value, action_spec=Bounded(-1, 1, shape=(2,)))
    loss.make_value_estimator(gamma=0.99)
    return loss


def batch_of(make, seed):
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    batch = TensorDict(
        observation=rand(SIZE, 3),
        next=TensorDict(
            observation=rand(SIZE, 3),
            reward=rand(SIZE, 1),
            terminated=rand(SIZE, 1) < 0.3,
            done=rand(SIZE, 1) < 0.3,
            batch_size=[SIZE],
        ),
        batch_size=[SIZE],
    )
    if make is ppo:
        batch["action"] = 1.8 * rand(SIZE, 2) - 0.9
        for name in ("action_log_prob", "advantage", "value_target", "state_value"):
            batch[name] = rand(SIZE, 1) if name != "action_log_prob" else rand(SIZE)
    elif make is sac:
        batch["action"] = 1.8 * rand(SIZE, 2) - 0.9
    else:
        batch["action"] = (5 * rand(SIZE)).long()
        batch["priority_weight"] = rand(SIZE)
    return batch


def of_the_module(loss, batch, parameters):
    """Entries, what was written and gradients, by plain autograd."""
    given = batch.copy()
    for parameter in parameters:
        parameter.grad = None
    entries = loss(given)
    sum(v for k, v in entries.items() if k.startswith("loss")).backward()
    gradients = [p.grad for p in parameters]
    for parameter in parameters:
        parameter.grad = None
    return entries.detach(), given, gradients


@pytest.mark.parametrize(
    "make",
    [rainbow, lambda: rainbow(noisy=True), ppo, sac],
    ids=["q", "noisy", "ppo", "sac"],
)
def test_it_is_the_loss_bit_for_bit(make):
    torch.manual_seed(0)
    loss = make()
    parameters = list(loss.parameters())
    traced = TracedLoss(loss, parameters)
    optimizer = torch.optim.Adam(parameters, lr=0.01)
    for step in range(4):
        if isinstance(loss, RainbowLoss):
            resample_noise(loss)
        batch = batch_of(make, step)
        state = torch.get_rng_state()
        entries, written, gradients = of_the_module(loss, batch, parameters)
        torch.set_rng_state(state)
        own = traced.backward(batch)
        assert set(own.keys()) == set(entries.keys())
        for key, value in entries.items():
            assert torch.equal(own[key], value), key
        assert set(batch.keys(True, True)) == set(written.keys(True, True))
        for key in written.keys(True, True):
            assert torch.equal(batch[key], written[key]), key
        for parameter, gradient in zip(parameters, gradients, strict=True):
            assert (parameter.grad is None) == (gradient is None)
            assert gradient is None or torch.equal(parameter.grad, gradient)
        # The next minibatch meets other weights.
        optimizer.step()
    assert None not in traced.graphs


def test_a_loss_that_looks_at_numbers_is_run_as_it_is():
    loss = Squares(looks=True)
    parameters = list(loss.parameters())
    traced = TracedLoss(loss, parameters)
    batch = TensorDict(observation=torch.rand(SIZE, 3), batch_size=[SIZE])
    entries, _, gradients = of_the_module(loss, batch, parameters)
    own = traced.backward(batch)
    assert own["loss_value"] == entries["loss_value"]
    assert torch.equal(parameters[0].grad, gradients[0])
    assert traced.graphs == [None]


def test_gradients_of_the_past_are_gone():
    loss = Squares()
    parameters = list(loss.parameters())
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    TracedLoss(loss, parameters).backward(
        TensorDict(observation=torch.zeros(SIZE, 3), batch_size=[SIZE])
    )
    assert (loss.network.weight.grad == 0.0).all()
    assert loss.unused.weight.grad is None, "no loss depends on it"


def test_other_kinds_of_minibatches_are_other_graphs():
    loss = Squares()
    traced = TracedLoss(loss, loss.parameters())
    for size in (4, 7, 4):
        rows = torch.rand(size, 3)
        own = traced.backward(TensorDict(observation=rows, batch_size=[size]))
        assert torch.equal(own["loss_value"], loss.network(rows).square().mean().detach())
    assert len(traced.graphs) == 2


def test_only_the_diagnostics_that_are_wanted_are_returned():
    loss = Squares()
    batch = TensorDict(observation=torch.rand(SIZE, 3), batch_size=[SIZE])
    keys = [
        set(TracedLoss(loss, loss.parameters(), diagnostics=wanted).backward(batch).keys())
        for wanted in (None, [], ["other"])
    ]
    assert keys == [{"loss_value", "other"}, {"loss_value"}, {"loss_value", "other"}]


def test_no_number_is_drawn_for_tracing():
    torch.manual_seed(0)
    loss = sac()
    traced = TracedLoss(loss, loss.parameters())
    torch.manual_seed(1)
    first = traced.backward(batch_of(sac, 0))
    after = torch.get_rng_state()
    torch.manual_seed(1)
    again = traced.backward(batch_of(sac, 0))
    assert (first == again).all()
    assert torch.equal(torch.get_rng_state(), after)


def test_weights_from_elsewhere_are_read_anew():
    network = TensorDictModule(nn.Linear(3, 1), ["observation"], ["value"])

    class AndAnother(Squares):
        def forward(self, tensordict):
            value = network(tensordict.copy())["value"]
            return TensorDict(loss=value.square().mean())

    loss = AndAnother()
    weight = network.module.weight
    traced = TracedLoss(loss, [weight])
    for factor in (1.0, 2.0):
        with torch.no_grad():
            weight.mul_(factor)
        rows = torch.rand(SIZE, 3)
        traced.backward(TensorDict(observation=rows, batch_size=[SIZE]))
        expected = torch.autograd.grad(network.module(rows).square().mean(), weight)[0]
        assert torch.equal(weight.grad, expected)


def test_a_mode_or_attribute_that_changes_within_the_network_is_followed():
    network = nn.Sequential(nn.Linear(3, 4), nn.Dropout(0.5), nn.Linear(4, 1))
    loss = SquareLoss(network)
    traced = TracedLoss(loss, list(loss.parameters()))

    def value():
        return float(traced.backward(square_batch())["loss"])

    for layer in network:
        layer.eval()
    with torch.no_grad():
        greedy = float(network(square_batch()["observation"]).square().mean())
    assert value() == pytest.approx(greedy)
    network[1].train()
    assert value() != pytest.approx(greedy)
    network[1].p = 0.0
    assert value() == pytest.approx(greedy)


class SquareLoss(LossModule):
    """Keeps its network out of sight, as TorchRL's losses do."""

    def __init__(self, network):
        super().__init__()
        self.__dict__["network"] = network
        self.weights = nn.ParameterList(network.parameters())

    def forward(self, batch):
        return TensorDict(loss=self.network(batch["observation"]).square().mean())


def square_batch():
    return TensorDict(
        observation=torch.linspace(-1.0, 1.0, 24).reshape(8, 3), batch_size=[8]
    )
