"""One update of a network: loss, gradients, a bound on their norm, the optimiser."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.objectives.common import LossModule

from gdrl_torchrl.objectives.traced_loss import TracedLoss


class Update:
    """Updates of the parameters that an optimiser has.

    Args:
        loss: The loss module; the sum of its losses is minimised.
        optimizer: The optimiser.
        max_grad_norm: Gradients of a larger norm, all together, are scaled to it.
        diagnostics: What the loss is to return beside its losses; None is everything.
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        max_grad_norm: float,
        *,
        diagnostics: Iterable[str] | None = None,
    ) -> None:
        self.optimizer = optimizer
        self.max_grad_norm = max_grad_norm
        self._parameters = [
            parameter for group in optimizer.param_groups for parameter in group["params"]
        ]
        self._loss = TracedLoss(loss, self._parameters, diagnostics=diagnostics)

    def __call__(self, batch: TensorDictBase) -> TensorDict:
        """Make one update; losses and diagnostics, detached, and ``grad_norm``."""
        losses = self._loss.backward(batch)
        norm = nn.utils.clip_grad_norm_(self._parameters, self.max_grad_norm, foreach=True)
        self.optimizer.step()
        return losses.set("grad_norm", norm)
