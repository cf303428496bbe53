"""A policy that acts on a few rows, without Python's share of the work."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs.utils import exploration_type

from gdrl_torchrl.modules.graph import Tensors, TracedFunction, trace


class TracedPolicy:
    """Some outputs of a policy for rows of numbers, exploring as it is set to.

    For a few rows nearly all of a policy's time is Python's: modules, tensordicts,
    distributions. Here it is traced once to a graph of tensor operations, and outputs
    that nobody asks for are not computed. It draws from torch's global generator what
    the policy would. The graph is used only if it gives the policy's own numbers, bit for
    bit; otherwise the policy is run.

    Args:
        policy: Any policy whose inputs are tensors.
        out_keys: The outputs that are wanted.
        trace: Whether to trace. A policy that keeps a state in Python objects must not
            be: tracing runs it.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from gdrl_torchrl.modules.actor import make_tanh_normal_actor
        >>> actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))
        >>> policy = TracedPolicy(actor, ["action"])
        >>> policy.take_up_weights()
        >>> [action] = policy([torch.zeros(5, 3)])
        >>> action.shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        out_keys: Sequence[NestedKey],
        *,
        trace: bool = True,
    ) -> None:
        self.policy = policy
        self.trace = trace
        self.in_keys = list(policy.in_keys)
        self.out_keys = list(out_keys)
        self._graphs: dict[Any, TracedFunction | None] = {}
        self._prepared: dict[Any, Tensors] = {}

    def take_up_weights(self) -> None:
        """Note that weights or buffers of the policy may have changed."""
        self._prepared.clear()

    @torch.no_grad()
    def __call__(self, inputs: Tensors) -> Sequence[torch.Tensor]:
        """Outputs ``[B, ...]`` in the order of the keys, for inputs ``[B, ...]`` so too."""
        # All that the operations depend on beside the numbers.
        key = (
            tuple((x.shape, x.dtype) for x in inputs),
            exploration_type(),
            self.policy.training,
        )
        if key not in self._graphs:
            graph = trace(self._run, self._weights(), inputs) if self.trace else None
            self._graphs[key] = graph
        graph = self._graphs[key]
        if graph is None:
            return self._run([], inputs)
        if key not in self._prepared:
            self._prepared[key] = graph.prepare(self._weights())
        return graph.run(self._prepared[key], inputs)

    def _weights(self) -> Tensors:
        return [*self.policy.parameters(), *self.policy.buffers()]

    def _run(self, weights: Tensors, inputs: Tensors) -> Tensors:
        rows = TensorDict(batch_size=inputs[0].shape[:1])
        for key, value in zip(self.in_keys, inputs, strict=True):
            rows.set(key, value)
        rows = self.policy(rows)
        return [rows.get(key) for key in self.out_keys]
