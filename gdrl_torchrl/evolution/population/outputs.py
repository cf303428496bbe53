"""The outputs of a policy before an action is chosen, as a function of its weights."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.func import functional_call
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import DistributionalQValueActor

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.genome import fitting_leaves
from gdrl_torchrl.evolution.population.members import split_actor
from gdrl_torchrl.private_copy import private_copy

Outputs = Callable[[TensorDictBase, torch.Tensor], torch.Tensor]


def writes_values(actor: TensorDictModuleBase) -> bool:
    """Whether a policy chooses by values of actions, which its network writes."""
    return "action_value" in split_actor(actor)[0].out_keys


def outputs_of(actor: TensorDictModuleBase) -> Outputs:
    """Make ``(genome, observation [D]) -> outputs [K]``, which is differentiable.

    The outputs are what the greedy action depends on: the values of discrete actions
    (means, if the values are distributions) or the location of continuous actions. If
    the actor writes neither, they are the last entry that its part with parameters writes.

    Args:
        actor: Any TorchRL actor without lazy layers.

    Returns:
        The function; the actor is not modified. Weights that a genome lacks are taken
        from the actor at that time.

    Examples:
        >>> from gdrl_torchrl.evolution.operators.genome import genome_of
        >>> from gdrl_torchrl.agents.networks import make_argmax_actor
        >>> from torchrl.data import Categorical
        >>> actor = make_argmax_actor(3, Categorical(5))
        >>> outputs_of(actor)(genome_of(actor), torch.zeros(3)).shape
        torch.Size([5])
    """
    kind: Any = type(actor)
    prefix, _ = split_actor(actor)
    written = next(
        (key for key in ("loc", "action_value") if key in prefix.out_keys),
        prefix.out_keys[-1],
    )
    has_atoms = isinstance(actor, DistributionalQValueActor)

    def outputs(genome: TensorDictBase, observation: torch.Tensor) -> torch.Tensor:
        # A forward pass may change its module, so a copy is run.
        prefix, _ = split_actor(private_copy(actor))
        own = dict(prefix.named_parameters())
        weights = own | fitting_leaves(genome, own, kind.__name__)
        rows = TensorDict({keys.OBSERVATION: observation}, batch_size=[])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            out: Any = functional_call(prefix, weights, (rows,))
        values = out.get(written)
        if has_atoms:
            support: torch.Tensor = actor.support  # pyright: ignore[reportAssignmentType]
            return support @ values.softmax(-2)
        return values

    return outputs
