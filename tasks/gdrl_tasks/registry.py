"""Tasks by name: ours, and those that other packages offer as entry points."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from gdrl_tasks.checks import check_choice
from gdrl_tasks.indoor.options import IndoorOptions
from gdrl_tasks.plugins import Offers, offers_of
from gdrl_tasks.water.options import WaterOptions

if TYPE_CHECKING:
    from dm_control.rl import control

    from gdrl_tasks.engines.batch import BatchSimulation
    from gdrl_tasks.task import NavigationTask

ENTRY_POINT_GROUP = "gdrl.tasks"


@dataclasses.dataclass(frozen=True)
class RegisteredTask:
    """A task's name, the dataclass of its options, and the function that makes it.

    A package offers such an object as an entry point in the group ``gdrl.tasks``.
    """

    name: str
    options: type
    make: Callable[[Any], NavigationTask]
    tags: tuple[str, ...] = ()


def _indoor(options: IndoorOptions) -> NavigationTask:
    from gdrl_tasks.indoor.task import IndoorTask

    return IndoorTask(options)


def _water(options: WaterOptions) -> NavigationTask:
    from gdrl_tasks.water.task import WaterTask

    return WaterTask(options)


# MuJoCo and numba are imported when a task is made, not when its options are asked for.
_BUILT_IN = (
    RegisteredTask("indoor", IndoorOptions, _indoor, tags=("continuous", "discrete")),
    RegisteredTask("water", WaterOptions, _water, tags=("continuous", "discrete")),
)


@functools.cache
def registered_tasks() -> Offers:
    """Built-in tasks and those of installed plugins, by name."""
    tasks = {task.name: task for task in _BUILT_IN}
    needs = tuple(field.name for field in dataclasses.fields(RegisteredTask))
    offers = offers_of(ENTRY_POINT_GROUP, needs=needs, taken=frozenset(tasks))
    # The name of a task is its own, and should be that of its entry point.
    return Offers({**{task.name: task for task in offers.values()}, **tasks}, offers.broken)


def task_names(tag: str | None = None) -> tuple[str, ...]:
    """Names of all registered tasks, or of those with a tag.

    Examples:
        >>> "water" in task_names("continuous")
        True
    """
    return tuple(
        n for n, task in registered_tasks().items() if tag is None or tag in task.tags
    )


def make_task(name: str, **options: Any) -> NavigationTask:
    """Make a task from its name and options.

    Raises:
        ValueError: If the task or an option is unknown, or a value is out of range.

    Examples:
        >>> make_task("water", sea="rough").options.sea
        'rough'
    """
    known = {field.name for field in dataclasses.fields(task_options(name))}
    for option, value in options.items():
        if option not in known:
            raise ValueError(
                f"unknown option {option}={value!r} of task {name!r}; "
                f"options are {sorted(known)}"
            )
    registered = registered_tasks()[name]
    return registered.make(registered.options(**options))


def task_options(name: str) -> type:
    """The dataclass of a task's options.

    Raises:
        ValueError: If the task is unknown.
    """
    check_choice("task", name, registered_tasks())
    return registered_tasks()[name].options


def load(
    name: str,
    *,
    random: int | np.random.RandomState | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> control.Environment:
    """Load a task as a dm_control environment with one world.

    Args:
        name: One of :func:`task_names`.
        random: Seed or state of the episodes, as in ``dm_control.suite``; None takes
            a different one every time.
        environment_kwargs: Arguments of ``control.Environment``, such as
            ``flat_observation``; times are options of the task.
        **options: Options of the task.

    Raises:
        ValueError: If the task or an option is unknown, a value is out of range, or
            ``environment_kwargs`` contradict the task.

    Examples:
        >>> environment = load("water", random=0)
        >>> sorted(environment.reset().observation)
        ['goal_bearing', 'goal_distance', 'pitch']
    """
    # Imported here because dm_control takes a second to import.
    from gdrl_tasks.engines.dm_env import make_environment

    return make_environment(
        make_task(name, **options),
        random=random,
        environment_kwargs=environment_kwargs,
    )


def simulate(
    name: str,
    *,
    num_worlds: int,
    num_threads: int = 0,
    seed: int | None = None,
    **options: Any,
) -> BatchSimulation:
    """Make many worlds of a task on ``mujoco.batch``.

    Args:
        name: One of :func:`task_names`.
        num_worlds: Number of worlds.
        num_threads: Threads; 0 takes one per allowed processor.
        seed: Seed of the episodes drawn by ``reset()``; None takes a different one
            every time (it is the ``seed`` of what is returned).
        **options: Options of the task.
    """
    from gdrl_tasks.engines.batch import BatchSimulation

    task = make_task(name, **options)
    return BatchSimulation(task, num_worlds, num_threads=num_threads, seed=seed)
