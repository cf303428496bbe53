"""Losses of small networks, batches for them, and the same sums as loops."""

from __future__ import annotations

import copy
import math

import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.agents.rainbow.loss import RainbowLoss
from gdrl_torchrl.agents.rainbow.network import make_q_actor

SIZE, ACTIONS, ATOMS, GAMMA = 3, 4, 11, 0.9
LOW, HIGH = -1.0, 2.0
RETURNS = [LOW + (HIGH - LOW) * i / (ATOMS - 1) for i in range(ATOMS)]


def make(noisy=False, **options):
    """A loss whose online and target networks differ, and actors equal to both."""
    options = {"num_atoms": ATOMS, "num_cells": (8, 8), "noisy": noisy} | options
    actor = make_q_actor(SIZE, ACTIONS, value_range=(LOW, HIGH), **options)
    loss = RainbowLoss(actor, gamma=GAMMA)
    target = copy.deepcopy(actor)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    return loss, actor, target


def make_batch(size=ATOMS, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return TensorDict(
        {
            "observation": 2.0 * normal(size, SIZE),
            "action": torch.randint(ACTIONS, (size,), generator=generator),
            "steps_to_next_obs": torch.randint(1, 6, (size, 1), generator=generator),
            "priority_weight": torch.rand(size, generator=generator) + 0.1,
            "next": {
                "observation": 2.0 * normal(size, SIZE),
                "reward": 0.6 * normal(size, 1),
                "terminated": normal(size, 1) > 0.5,
                "done": torch.zeros(size, 1, dtype=torch.bool),
            },
        },
        batch_size=[size],
    )


def brute_force_projection(chances, reward, discount, returns):
    """Each atom's probability, split between the two atoms around where it lands."""
    gap = (returns[-1] - returns[0]) / (len(returns) - 1)
    out, outside = [0.0] * len(returns), 0.0
    for chance, value in zip(chances, returns, strict=True):
        lands = reward + discount * value
        if lands < returns[0] - 1e-3 * gap or lands > returns[-1] + 1e-3 * gap:
            outside += chance
        lands = min(max(lands, returns[0]), returns[-1])
        for atom, other in enumerate(returns):
            out[atom] += chance * max(0.0, 1.0 - abs(lands - other) / gap)
    return out, outside


def distributions(actor, observation):
    """Probabilities ``[B][Z][A]`` in double precision, from the stock actor."""
    rows = TensorDict(observation=observation, batch_size=observation.shape[:1])
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        return actor(rows)["action_value"].double().exp().tolist()


def brute_force(online, target, batch, gamma=GAMMA, returns=RETURNS):
    """Cross-entropy, entropy of the target, value and clipped mass, per transition."""
    now = distributions(online, batch["observation"])
    ahead = distributions(online, batch["next", "observation"])
    delayed = distributions(target, batch["next", "observation"])
    rows = []
    for i in range(batch.batch_size[0]):
        means = [
            sum(ahead[i][z][a] * returns[z] for z in range(len(returns)))
            for a in range(len(ahead[i][0]))
        ]
        best = means.index(max(means))
        steps = int(batch["steps_to_next_obs"].reshape(-1)[i])
        ended = bool(batch["next", "terminated"][i, 0])
        projected, outside = brute_force_projection(
            [delayed[i][z][best] for z in range(len(returns))],
            float(batch["next", "reward"][i, 0]),
            0.0 if ended else gamma**steps,
            returns,
        )
        action = int(batch["action"].reshape(-1)[i])
        own = [now[i][z][action] for z in range(len(returns))]
        pairs = list(zip(projected, own, strict=True))
        rows.append(
            (
                -sum(m * math.log(p) for m, p in pairs),
                -sum(m * math.log(m) for m, _ in pairs if m > 0.0),
                sum(p * value for p, value in zip(own, returns, strict=True)),
                outside,
            )
        )
    return torch.tensor(rows, dtype=torch.float64).unbind(dim=-1)
