"""By how much a switch changes what an agent takes states to be worth."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.population.outputs import Outputs, outputs_of, writes_values

_ROWS = 256


class ValueShift:
    """Compares the values of actions before and after a switch, on the last batch.

    A fitness sees only which action is the best. A child may win with values that nobody
    would have learnt, and the next updates are made of them.

    Args:
        actor: The agent's policy. One that writes no ``action_value`` has no shift: its
            critic stays as it is.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from gdrl_torchrl.agents.networks import make_argmax_actor
        >>> from gdrl_torchrl.evolution.operators.genome import genome_of
        >>> actor = make_argmax_actor(3, Categorical(5))
        >>> shift = ValueShift(actor)
        >>> rows = torch.rand(2, 8, 3)
        >>> _ = shift.observe(TensorDict(observation=rows, batch_size=[2, 8]))
        >>> shift(genome_of(actor), genome_of(actor))
        0.0
    """

    def __init__(self, actor: TensorDictModuleBase) -> None:
        self._outputs: Outputs | None = outputs_of(actor) if writes_values(actor) else None
        self._observations: torch.Tensor | None = None

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """Keep some observations of a batch ``[W, T]``."""
        if self._outputs is not None:
            seen = batch[keys.OBSERVATION]
            rows = seen.reshape(-1, seen.shape[-1])
            stride = max(1, len(rows) // _ROWS)
            self._observations = rows[::stride][:_ROWS]
        return batch

    @torch.no_grad()
    def __call__(self, before: TensorDictBase, after: TensorDictBase) -> float | None:
        """Root mean square change of the values, over their standard deviation before.

        Args:
            before: The agent's genome before the switch.
            after: The one after it.

        Returns:
            None if the policy has no values, or no batch was observed.
        """
        if self._outputs is None or self._observations is None:
            return None
        values = torch.vmap(self._outputs, in_dims=(None, 0))
        old, new = (values(genome, self._observations) for genome in (before, after))
        return float((new - old).square().mean().sqrt() / old.std())
