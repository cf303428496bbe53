"""What happens to the agent when a member takes its place."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


@torch.no_grad()
def move_target(loss: Any, name: str, tau: float) -> None:
    """Move a network's target a share ``tau`` of the way to it, if it has a target."""
    target = f"target_{name}_params"
    # Without a target network this attribute is a view of the network's own weights.
    if target not in dict(loss.named_children()):
        return
    targets = getattr(loss, target)
    for key, source in getattr(loss, f"{name}_params").items(True, True):
        if isinstance(source, nn.Parameter):
            targets.get(key).lerp_(source, tau)
