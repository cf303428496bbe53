"""One update of a network: loss, gradients, a bound on their norm, the optimiser."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDict, TensorDictBase
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
        norm = self._clip_gradients()
        self.optimizer.step()
        return losses.set("grad_norm", norm)

    @torch.no_grad()
    def _clip_gradients(self) -> torch.Tensor:
        """As ``clip_grad_norm_`` of torch, which groups tensors by device first."""
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        norm = torch.stack(torch._foreach_norm(gradients)).norm()
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp_max(1.0)
        torch._foreach_mul_(gradients, scale)
        return norm
