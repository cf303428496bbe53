"""Losses and their gradients as a graph: TorchRL's numbers without its overhead."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives.common import LossModule

from gdrl_torchrl.fast.graph import Tensors, TracedFunction, trace
from gdrl_torchrl.private_copy import plain_attributes


class TracedLoss:
    """A loss module's losses and gradients for minibatches that are alike.

    At least half of the time of a small network's update goes into Python: tensordicts,
    modules, distributions, autograd's bookkeeping. Here loss and backward pass are traced
    once to a graph of tensor operations. The graph is used only if it gives the losses and
    gradients of the module, bit for bit; otherwise the module is run.

    Args:
        loss: The loss module. It must depend on nothing but the minibatch, its
            parameters, its buffers and torch's global generator. Parameters and buffers
            may change in place, but must stay the same tensors.
        parameters: Parameters whose gradients are computed. As in TorchRL's trainers the
            sum of all entries whose names begin with ``loss`` is minimised.
        diagnostics: Other entries that are returned; None means all. The others are not
            computed.

    Examples:
        >>> from gdrl_torchrl.agents.rainbow.network import make_q_actor
        >>> from gdrl_torchrl.agents.rainbow.loss import RainbowLoss
        >>> loss = RainbowLoss(make_q_actor(3, 5, value_range=(-1.0, 1.0)), gamma=0.99)
        >>> batch = TensorDict(
        ...     observation=torch.zeros(7, 3),
        ...     action=torch.zeros(7, dtype=torch.long),
        ...     next=TensorDict(
        ...         observation=torch.zeros(7, 3),
        ...         reward=torch.zeros(7, 1),
        ...         terminated=torch.zeros(7, 1, dtype=torch.bool),
        ...     ),
        ...     batch_size=[7],
        ... )
        >>> parameters = list(loss.parameters())
        >>> sorted(TracedLoss(loss, parameters).backward(batch).keys())
        ['clipped_mass', 'loss', 'q_mean']
        >>> parameters[0].grad.shape == parameters[0].shape
        True
    """

    def __init__(
        self,
        loss: LossModule,
        parameters: Iterable[torch.Tensor],
        *,
        diagnostics: Iterable[str] | None = None,
    ) -> None:
        self.loss = loss
        self.parameters = list(parameters)
        self.diagnostics = None if diagnostics is None else set(diagnostics)
        # Losses hide their networks from ``modules()``, so look at attributes too.
        parts = [loss, *(x for x in vars(loss).values() if isinstance(x, nn.Module))]
        every = (module for part in parts for module in part.modules())
        self._attributes = plain_attributes(dict.fromkeys(every))
        self._traced: dict[Any, _Traced] = {}

    def backward(self, batch: TensorDictBase) -> TensorDict:
        """Set the parameters' gradients to those of a minibatch.

        Earlier gradients are replaced. Entries that the loss writes, such as priorities,
        are written to the minibatch.

        Args:
            batch: A minibatch ``[B]``.

        Returns:
            Losses and diagnostics, detached.
        """
        key = self._signature(batch)
        if key not in self._traced:
            self._traced[key] = _Traced(self, batch)
        return self._traced[key](batch)

    @property
    def graphs(self) -> list[TracedFunction | None]:
        """Of each kind of minibatches so far; None where tracing failed."""
        return [traced.graph for traced in self._traced.values()]

    def _signature(self, batch: TensorDictBase) -> Any:
        """What the operations depend on, except numbers and types of entries."""
        following = batch.get("next", None)
        names = () if following is None else tuple(following.keys())
        return batch.batch_size, tuple(batch.keys()), names, self._attributes()


class _Traced:
    """The graph for minibatches of one kind, or the loss itself where tracing failed."""

    def __init__(self, owner: TracedLoss, batch: TensorDictBase) -> None:
        self.loss, self.parameters = owner.loss, owner.parameters
        state = torch.get_rng_state()
        trial = batch.copy()
        losses = self.loss(trial)
        wanted = owner.diagnostics
        self.names = [
            name
            for name in map(str, losses.keys())
            if wanted is None or name in wanted or name.startswith("loss")
        ]
        given = dict(_items(batch))
        self.written = [key for key, x in _items(trial) if x is not given.get(key)]
        self.keys = list(given)
        tensors = list(given.values())
        has_gradient = torch.autograd.grad(
            self._total(losses), self.parameters, allow_unused=True
        )
        self.reached = [
            parameter
            for parameter, gradient in zip(self.parameters, has_gradient, strict=True)
            if gradient is not None
        ]
        torch.set_rng_state(state)
        # A network and its target may share some weights.
        weights = [*self.loss.parameters(), *self.loss.buffers()]
        self.weights = list({id(tensor): tensor for tensor in weights}.values())
        self.graph: TracedFunction | None = trace(self._run, self.weights, tensors)

    def __call__(self, batch: TensorDictBase) -> TensorDict:
        inputs = [batch.get(key) for key in self.keys]
        if self.graph is None:
            outputs = self._run([], inputs)
        else:
            outputs = self.graph.run(self.graph.prepare(self.weights), inputs)
        count = len(self.names)
        for parameter in self.parameters:
            parameter.grad = None
        for parameter, gradient in zip(self.reached, outputs, strict=False):
            parameter.grad = gradient
        rest = outputs[len(self.reached) :]
        for key, value in zip(self.written, rest[count:], strict=True):
            batch.set(key, value)
        return TensorDict(dict(zip(self.names, rest[:count], strict=True)))

    def _run(self, constants: Tensors, inputs: Tensors) -> Tensors:
        size = inputs[0].shape[:1]
        batch = TensorDict(batch_size=size)
        for key, value in zip(self.keys, inputs, strict=True):
            batch.set(key, value)
        with torch.enable_grad():
            losses = self.loss(batch)
            gradients = torch.autograd.grad(self._total(losses), self.reached)
        returned = [losses.get(name).detach() for name in self.names]
        return [*gradients, *returned, *(batch.get(key) for key in self.written)]

    def _total(self, losses: TensorDictBase) -> Any:
        return sum(losses.get(name) for name in self.names if name.startswith("loss"))


def _items(batch: TensorDictBase) -> Iterable[tuple[Any, torch.Tensor]]:
    return batch.items(include_nested=True, leaves_only=True)
