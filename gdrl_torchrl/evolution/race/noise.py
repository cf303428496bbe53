"""The noise that a policy explores with, where it is a parameter of its own."""

from __future__ import annotations

import math

import torch
from torch import nn

_NAME = "state_independent_scale"
_LEAST_STD = 0.1
"""With less noise there is next to no exploration, and gradients explode."""


class ActionNoise:
    """Standard deviation of a Gaussian policy's actions, before they are squashed.

    Args:
        actor: A policy with TorchRL's ``AddStateIndependentNormalScale``, whose mapping is
            ``exp``, as :func:`~gdrl_torchrl.agents.networks.make_tanh_normal_actor` makes.

    Raises:
        ValueError: If it has no such part.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from gdrl_torchrl.agents.networks import make_tanh_normal_actor
        >>> noise = ActionNoise(make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,))))
        >>> noise.set(0.5)
        >>> noise.scale(0.5)
        >>> round(noise.std, 2)
        0.25
    """

    def __init__(self, actor: nn.Module) -> None:
        found = [p for n, p in actor.named_parameters() if n.split(".")[-1] == _NAME]
        if not found:
            raise ValueError(
                f"action_std needs a policy with a parameter {_NAME!r}, which "
                f"{type(actor).__name__} has not: give action_std=None"
            )
        self._logarithms = found

    @property
    def std(self) -> float:
        """Mean over the actions."""
        return float(torch.cat([p.detach().exp() for p in self._logarithms]).mean())

    @torch.no_grad()
    def set(self, std: float) -> None:
        """Give every action this standard deviation."""
        for logarithm in self._logarithms:
            logarithm.fill_(math.log(std))

    @torch.no_grad()
    def scale(self, factor: float) -> None:
        """Multiply the standard deviations, down to a tenth and no further."""
        least = math.log(_LEAST_STD)
        for logarithm in self._logarithms:
            lower = (logarithm + math.log(factor)).clamp(min=least)
            logarithm.copy_(torch.minimum(logarithm, lower))
