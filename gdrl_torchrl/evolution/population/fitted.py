"""The greedy actions of many members, which can be differentiated by their weights."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.func import functional_call

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.distillation import Act, Bind
from gdrl_torchrl.evolution.operators.genome import fitting_leaves
from gdrl_torchrl.evolution.population.members import finished, split_actor
from gdrl_torchrl.private_copy import private_copy


def greedy_actions_of(actor: TensorDictModuleBase) -> Bind:
    """Make ``genomes [K] -> (observation [K, B, D] -> actions [K, B, A])``.

    What a policy has prepared itself is taken where it has
    (:class:`~gdrl_torchrl.evolution.population.prepared.Prepares`).

    Args:
        actor: A policy of continuous actions that reads ``observation``.

    Returns:
        The function; the actor is not modified. Weights that a genome lacks, and buffers,
        are the actor's at this time. What it returns follows its genomes where they are
        changed in place.

    Raises:
        ValueError: If the policy reads another entry, or cannot be copied.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from gdrl_torchrl.agents.networks import make_tanh_normal_actor
        >>> from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
        >>> actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))
        >>> genomes = stack_copies(genome_of(actor), 4)
        >>> greedy_actions_of(actor)(genomes)(torch.zeros(4, 5, 3)).shape
        torch.Size([4, 5, 2])
    """
    if list(actor.in_keys) != [keys.OBSERVATION]:
        raise ValueError(
            f"the policy reads {list(actor.in_keys)}: only one that reads "
            f"{keys.OBSERVATION!r} can be distilled"
        )
    copied = private_copy(actor)
    kind: Any = type(copied)
    parameters = dict(copied.named_parameters())
    own = {
        name: value.detach().clone()
        for name, value in (*parameters.items(), *copied.named_buffers())
    }
    prefix, heads = split_actor(copied)

    def call(weights: TensorDictBase, rows: TensorDictBase) -> TensorDictBase:
        out: Any = functional_call(prefix, dict(weights.items()), (rows,))
        return out.select(*prefix.out_keys, strict=False)

    vmapped = torch.vmap(call, in_dims=(0, 0), randomness="different")

    def bind(genomes: TensorDictBase) -> Act:
        size = genomes.batch_size
        given = fitting_leaves(genomes, parameters, kind.__name__)
        rest = {n: v.expand(*size, *v.shape) for n, v in own.items() if n not in given}
        weights = TensorDict(rest | given, batch_size=size)
        nested = weights.unflatten_keys(".")

        def act(observation: torch.Tensor) -> torch.Tensor:
            # What is prepared depends on weights, so it is made anew.
            run = copied.prepared(nested) if hasattr(kind, "prepared") else None
            if run is not None:
                return run(observation)[0]
            rows = TensorDict({keys.OBSERVATION: observation}, observation.shape[:2])
            written = vmapped(weights, rows).reshape(-1)
            action = finished(written, heads, [keys.ACTION])[keys.ACTION]
            return action.unflatten(0, observation.shape[:2])

        return act

    return bind
