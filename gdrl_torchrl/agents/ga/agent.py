"""The agent of the genetic algorithm."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Categorical

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import ACTIVATIONS, Agent
from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.networks import make_argmax_actor, make_tanh_normal_actor
from gdrl_torchrl.agents.settings import NetworkConfig


def make_ga_actor(
    task: NavigationTask, network: NetworkConfig, settings: GAConfig
) -> TensorDictModuleBase:
    """A policy of the family that evolves: as large as the other agents' policies."""
    size = task.spec.action_size
    shape: dict[str, Any] = {
        "num_cells": tuple(network.actor_cells),
        "activation": ACTIVATIONS[network.activation],
    }
    if task.spec.is_discrete:
        return make_argmax_actor(task.spec.observation_size, Categorical(size), **shape)
    spec = Bounded(low=-1.0, high=1.0, shape=torch.Size([size]), dtype=torch.float32)
    return make_tanh_normal_actor(task.spec.observation_size, spec, **shape)


def make_ga_agent(
    task: NavigationTask, network: NetworkConfig, settings: GAConfig, **others: Any
) -> Agent:
    """A policy to hold the result; it needs nothing else."""
    return Agent(make_ga_actor(task, network, settings))
