"""Observations of the episodes of a small population."""

from __future__ import annotations

import torch
from tensordict import TensorDict

MEMBERS, EPISODES = 4, 5


def rows(count=MEMBERS * EPISODES, size=3):
    generator = torch.Generator().manual_seed(2)
    observation = torch.randn(count, size, generator=generator)
    return TensorDict(observation=observation, batch_size=[count])
