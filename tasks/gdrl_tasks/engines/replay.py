"""A step of a world that diverged, once more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gdrl_tasks.engines.batch import BatchSimulation
from gdrl_tasks.task import NavigationTask


def repeat_step(
    task: NavigationTask, before: Mapping[str, np.ndarray], action: np.ndarray
) -> BatchSimulation:
    """Make a step from a state; returns the simulation of one world after the step.

    Args:
        task: The task, perhaps with other options.
        before: The state before the step, as
            :attr:`~gdrl_tasks.engines.divergence.DivergedWorld.before` has it.
        action: The action, ``[A]`` or ``[]``.

    Raises:
        ValueError: If the state or the action is not one of the task's.

    Examples:
        >>> from gdrl_tasks import simulate
        >>> worlds, diverged = simulate("water", num_worlds=3), []
        >>> worlds.watch(diverged.append)
        >>> _ = worlds.reset()
        >>> worlds.qvel[1, 0] = np.inf
        >>> _ = worlds.step(np.zeros((3, 2)))
        >>> diverged[0].world, diverged[0].steps
        (1, 0)
        >>> again = repeat_step(worlds.task, diverged[0].before, diverged[0].action)
        >>> again.arrays["outcome"]
        array([4])
    """
    simulation = BatchSimulation(task, 1, num_threads=1)
    own = ("qpos", "qvel", "engine")
    state = {
        name if name in own else f"arrays.{name}": value for name, value in before.items()
    }
    counters = simulation.get_state()
    for name in ("seed", "num_episodes_begun"):
        state[name] = counters[name]
    simulation.set_state(state)
    simulation.step(action[None])
    return simulation
