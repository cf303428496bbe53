"""A policy that acts on a few rows, with little Python between its operations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs.utils import exploration_type

from gdrl_torchrl.fast.graph import Tensors, TracedFunction, trace
from gdrl_torchrl.private_copy import plain_attributes


class TracedPolicy:
    """Some outputs of a policy for rows of numbers, with the exploration that is set.

    For a few rows nearly all of a policy's time goes into Python: modules, tensordicts,
    distributions. Here the policy is traced once to a graph of tensor operations, and
    outputs that are not asked for are not computed. The graph draws the same numbers from
    torch's global generator as the policy. It is used only if it gives the policy's
    numbers, bit for bit; otherwise the policy is run. The policy is traced anew when a
    mode of its modules, or an attribute that is a number or text, has changed.

    Args:
        policy: Any policy whose inputs are tensors.
        out_keys: The outputs that are wanted.
        trace: Whether to trace. A policy that keeps a state in Python objects must not
            be traced, because tracing runs it and so changes its state.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from gdrl_torchrl.agents.networks import make_tanh_normal_actor
        >>> actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))
        >>> policy = TracedPolicy(actor, ["action"])
        >>> act = policy.bind([torch.zeros(5, 3)])
        >>> [action] = act(torch.ones(5, 3))
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
        self._attributes = plain_attributes(policy.modules())
        self.graphs: dict[Any, TracedFunction | None] = {}
        """Of each kind of inputs so far; None where tracing failed."""

    @torch.no_grad()
    def bind(self, inputs: Tensors) -> Callable[..., Sequence[torch.Tensor]]:
        """Make a function of the policy with its weights and buffers as they are now.

        Args:
            inputs: Any inputs ``[B, ...]``, in the order of the policy's keys.

        Returns:
            A function of inputs of these shapes, one argument each, that gives the
            outputs ``[B, ...]`` with the exploration that is set now.
        """
        # All that the operations depend on, except numbers.
        key = (
            tuple((x.shape, x.dtype) for x in inputs),
            exploration_type(),
            self._attributes(),
        )
        weights = self._weights()
        if key not in self.graphs:
            graph = trace(self._run, weights, inputs) if self.trace else None
            self.graphs[key] = graph
        graph = self.graphs[key]
        if graph is None:
            return lambda *inputs: self._run([], list(inputs))
        return graph.bind(weights)

    def _weights(self) -> Tensors:
        return [*self.policy.parameters(), *self.policy.buffers()]

    def _run(self, weights: Tensors, inputs: Tensors) -> Tensors:
        rows = TensorDict(batch_size=inputs[0].shape[:1])
        for key, value in zip(self.in_keys, inputs, strict=True):
            rows.set(key, value)
        rows = self.policy(rows)
        return [rows.get(key) for key in self.out_keys]
