"""The noise that a policy explores with, where it is a parameter of its own."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import torch
from torch import nn

_NAME = "state_independent_scale"


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
        >>> with noise.limited(0.5):
        ...     round(noise.std, 2)
        0.5
        >>> noise.std > 0.5
        True
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
    def limit(self, std: float) -> None:
        """Give no action a larger standard deviation than this."""
        for logarithm in self._logarithms:
            logarithm.clamp_(max=math.log(std))

    @contextlib.contextmanager
    def limited(self, std: float) -> Iterator[None]:
        """Do so for a while."""
        before = [logarithm.detach().clone() for logarithm in self._logarithms]
        self.limit(std)
        try:
            yield
        finally:
            with torch.no_grad():
                for logarithm, value in zip(self._logarithms, before, strict=True):
                    logarithm.copy_(value)
