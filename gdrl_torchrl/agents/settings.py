"""What every agent can be told, and checks that several share."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from gdrl_torchrl.checks import (
    among,
    check_fields,
    check_weights,
    limits,
    within,
)

if TYPE_CHECKING:
    from gdrl_tasks import NavigationTask

_WIDTHS = limits(lengths=(1, 16), least=1, most=16_384)


@dataclasses.dataclass
class NetworkConfig:
    """Networks of the agent."""

    actor_cells: list[int] = dataclasses.field(
        default_factory=lambda: [32, 32], metadata=_WIDTHS
    )
    """Widths of the policy's hidden layers."""
    critic_cells: list[int] = dataclasses.field(
        default_factory=lambda: [64, 64], metadata=_WIDTHS
    )
    """Widths of the critic's hidden layers, where there is one."""
    critic_sees_time: bool = True
    """Whether the critic reads the time left, which the policy does not see."""
    activation: str = among("tanh", ("tanh", "relu"))
    """Between hidden layers."""
    initial_std: float = within(1.0, least=1e-4, most=100.0)
    """Of the policy before squashing, for continuous actions."""

    def __post_init__(self) -> None:
        check_fields(self, "network")
        for name in ("actor_cells", "critic_cells"):
            check_weights(f"network.{name}", getattr(self, name))


def check_whole_rows(frames_per_batch: int, num_worlds: int) -> None:
    """Raise ValueError unless every world gives equally many frames of a batch."""
    if frames_per_batch % num_worlds:
        raise ValueError(
            f"algorithm.frames_per_batch={frames_per_batch} must be a multiple "
            f"of algorithm.num_worlds={num_worlds}"
        )


def check_actions(task: NavigationTask, settings: Any) -> None:
    """Raise ValueError unless an algorithm can give the actions that a task needs."""
    given = "discrete" if task.spec.is_discrete else "continuous"
    if settings.actions not in ("any", given):
        raise ValueError(
            f"task.actions={given!r} must be {settings.actions!r} with algorithm.name="
            f"{settings.name!r}: give task.actions={settings.actions}"
        )
