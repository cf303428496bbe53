"""One update of a network: loss, gradients, a bound on their norm, the optimiser."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives.common import LossModule

from gdrl_torchrl.agents.means import Means
from gdrl_torchrl.fast.loss import TracedLoss

_logger = logging.getLogger(__name__)


class NonFiniteUpdateError(RuntimeError):
    """A loss, a gradient or a parameter is not a finite number.

    Attributes:
        names: What is not finite: losses, ``gradient of`` parameters, or parameters.
        batch: The minibatch ``[B]``.
    """

    advice = (
        "The same command goes on from there; faults.on_non_finite_update=skip makes no "
        "such updates"
    )

    def __init__(self, names: list[str], batch: TensorDictBase) -> None:
        super().__init__(f"not finite in an update: {', '.join(names)}")
        self.names = names
        self.batch = batch


class Update:
    """Updates of the parameters that an optimiser has.

    Args:
        loss: The loss module; the sum of its losses is minimised.
        optimizer: The optimiser.
        max_grad_norm: Gradients of a larger norm, all together, are scaled to it.
        diagnostics: What the loss is to return beside its losses in those updates that
            are diagnosed.
        noted: Names of what else is added to ``means``.
        on_non_finite: What a loss or a gradient that is not finite leads to: ``stop``
            raises an error before anything is changed, ``skip`` makes no update.

    Attributes:
        num_skipped: Updates that were not made.
        skipped: Whether the last one was not.
        means: Of losses, diagnostics and ``grad_norm`` of the updates that were made.
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        max_grad_norm: float,
        *,
        diagnostics: Sequence[str] = (),
        noted: Iterable[str] = (),
        on_non_finite: str = "stop",
    ) -> None:
        self.optimizer = optimizer
        self.max_grad_norm = max_grad_norm
        self.on_non_finite = on_non_finite
        self.num_skipped = 0
        self.skipped = False
        self._parameters = [
            parameter for group in optimizer.param_groups for parameter in group["params"]
        ]
        named = {id(parameter): name for name, parameter in loss.named_parameters()}
        self._names = [
            named.get(id(p), f"parameter {i}") for i, p in enumerate(self._parameters)
        ]
        names = map(str, loss.out_keys)
        minimised = [name for name in names if name.startswith("loss")]
        self.means = Means([*minimised, "grad_norm", *diagnostics, *noted])
        # What nobody reads is not computed: in most updates, diagnostics.
        self.traced_loss = TracedLoss(loss, self._parameters, diagnostics=[])
        self._diagnosed = TracedLoss(loss, self._parameters, diagnostics=diagnostics)

    def __call__(self, batch: TensorDictBase, *, diagnose: bool = False) -> TensorDict:
        """Make one update.

        Args:
            batch: A minibatch ``[B]``.
            diagnose: Whether to ask the loss for its diagnostics as well. Gradients are
                the same bit for bit.

        Returns:
            Losses and, if asked for, diagnostics, detached; and ``grad_norm``.

        Raises:
            NonFiniteUpdateError: If a loss or a gradient is not finite, unless such
                updates are skipped, or a parameter is not.
        """
        loss = self._diagnosed if diagnose else self.traced_loss
        losses = loss.backward(batch)
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        with torch.no_grad():
            norm = torch.stack(torch._foreach_norm(gradients)).norm()
        losses.set("grad_norm", norm)
        minimised: list[Any] = [x for n, x in losses.items() if n.startswith("loss")]
        self.skipped = not self._are_finite([norm, *minimised])
        if self.skipped:
            self._skip(losses, batch)
            return losses
        self._clip(gradients, norm)
        self.optimizer.step()
        if not self._are_finite(self._parameters):
            raise NonFiniteUpdateError(self._non_finite(losses), batch)
        self.means.add(losses.items())
        return losses

    @torch.no_grad()
    def _clip(self, gradients: list[torch.Tensor], norm: torch.Tensor) -> None:
        """As ``clip_grad_norm_`` of torch, which groups tensors by device first."""
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp_max(1.0)
        torch._foreach_mul_(gradients, scale)

    def _skip(self, losses: TensorDictBase, batch: TensorDictBase) -> None:
        error = NonFiniteUpdateError(self._non_finite(losses), batch)
        # With a parameter that is not finite no later update would be either.
        if self.on_non_finite == "stop" or not self._are_finite(self._parameters):
            raise error
        self.num_skipped += 1
        _logger.warning("update skipped: %s", error)

    @torch.no_grad()
    def _are_finite(self, tensors: list[torch.Tensor]) -> bool:
        return bool(torch.stack(torch._foreach_norm(tensors)).isfinite().all())

    def _non_finite(self, losses: TensorDictBase) -> list[str]:
        """Names of what is not finite."""
        gradients = [
            (f"gradient of {name}", p.grad)
            for name, p in zip(self._names, self._parameters, strict=True)
            if p.grad is not None
        ]
        parameters = zip(self._names, self._parameters, strict=True)
        named = [*losses.items(), *gradients, *parameters]
        return [str(name) for name, x in named if not bool(torch.isfinite(x).all())]
