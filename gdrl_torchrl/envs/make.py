"""Environments from a task and a choice of backend."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Literal

from torchrl.envs import EnvBase

from gdrl_tasks import NavigationTask
from gdrl_tasks.engines.divergence import DivergedWorld
from gdrl_torchrl.envs.navigation import NavigationEnv

Backend = Literal["batch", "dm_control"]
OnDivergence = Callable[[DivergedWorld], None] | None
"""Called with every world of the ``batch`` backend that diverges."""


def make_env(
    task: NavigationTask,
    num_worlds: int,
    *,
    backend: Backend = "batch",
    num_threads: int = 0,
    seed: int | None = None,
    on_divergence: OnDivergence = None,
) -> EnvBase:
    """Make an environment of batch size ``[num_worlds]``.

    Args:
        task: The task.
        num_worlds: Number of worlds.
        backend: ``batch`` steps all worlds on ``mujoco.batch``; ``dm_control`` runs
            that many dm_control environments in this process, one after another.
        num_threads: Simulation threads of the ``batch`` backend; 0 takes one per
            allowed processor.
        seed: Seed of the episodes; None takes a different one every time.
        on_divergence: See :data:`OnDivergence`.

    Raises:
        ValueError: If ``num_worlds`` < 1 or ``backend`` is unknown.

    Examples:
        >>> from gdrl_tasks import make_task
        >>> make_env(make_task("water"), 3, backend="dm_control").batch_size
        torch.Size([3])
    """
    if num_worlds < 1:
        raise ValueError(f"num_worlds={num_worlds} must be >= 1")
    if backend == "batch":
        env = NavigationEnv(task, num_worlds, num_threads=num_threads, seed=seed)
        if on_divergence is not None:
            env.watch(on_divergence)
        return env
    if backend != "dm_control":
        raise ValueError(f"backend={backend!r} must be 'batch' or 'dm_control'")
    # dm_control takes a second to import, and nothing else here needs it.
    from gdrl_torchrl.envs.dm_control import NavigationDMControlEnv, SerialWorlds

    seeds = [None if seed is None else seed * 1000 + n for n in range(num_worlds)]
    makers = [functools.partial(NavigationDMControlEnv, task, seed=own) for own in seeds]
    return SerialWorlds(num_worlds, makers)
