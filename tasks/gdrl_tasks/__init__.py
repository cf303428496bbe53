"""Navigation tasks in MuJoCo, written once as array functions.

>>> import gdrl_tasks
>>> environment = gdrl_tasks.load("water", random=0)
>>> worlds = gdrl_tasks.simulate("water", num_worlds=4)
"""

from gdrl_tasks.batch import BatchSimulation, StepResult
from gdrl_tasks.navigation import Outcome
from gdrl_tasks.registry import (
    RegisteredTask,
    load,
    make_task,
    simulate,
    task_names,
    task_options,
)
from gdrl_tasks.seeds import Stream, episode_seeds
from gdrl_tasks.task import Episode, NavigationTask, TaskSpec

__all__ = [
    "BatchSimulation",
    "Episode",
    "NavigationTask",
    "Outcome",
    "RegisteredTask",
    "StepResult",
    "Stream",
    "TaskSpec",
    "episode_seeds",
    "load",
    "make_task",
    "simulate",
    "task_names",
    "task_options",
]
