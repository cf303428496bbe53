"""Navigation tasks in MuJoCo, written once as array functions.

>>> import gdrl_tasks
>>> environment = gdrl_tasks.load("water", random=0)
>>> worlds = gdrl_tasks.simulate("water", num_worlds=4)
"""

import importlib
from typing import TYPE_CHECKING, Any

from gdrl_tasks.definition import Outcome
from gdrl_tasks.registry import (
    RegisteredTask,
    load,
    make_task,
    simulate,
    task_names,
    task_options,
)
from gdrl_tasks.seeds import Stream, episode_seeds

if TYPE_CHECKING:
    from gdrl_tasks.engines.batch import BatchSimulation, StepResult
    from gdrl_tasks.spec import Episode, TaskSpec
    from gdrl_tasks.task import NavigationTask

# Modules that import MuJoCo and numba, which take half a second, are imported on use.
_LAZY = {
    "BatchSimulation": "gdrl_tasks.engines.batch",
    "StepResult": "gdrl_tasks.engines.batch",
    "Episode": "gdrl_tasks.spec",
    "NavigationTask": "gdrl_tasks.task",
    "TaskSpec": "gdrl_tasks.spec",
}

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


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
