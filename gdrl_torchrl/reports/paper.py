"""The numbers of the paper, AAMAS 2020, that ours are shown beside."""

from __future__ import annotations

import dataclasses
import functools
import json
from importlib import resources
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class PaperCurve:
    """A curve of Figure 2: success of training over episodes of the agent.

    Attributes:
        method: As the paper calls it.
        agent_episodes: Episodes, ``[K]``.
        success: From 0 to 1, ``[K]``, within 0.02.
    """

    method: str
    agent_episodes: np.ndarray
    success: np.ndarray


@functools.cache
def paper() -> dict[str, Any]:
    """All of ``paper.json``."""
    return json.loads(
        resources.files("gdrl_torchrl.reports").joinpath("paper.json").read_text()
    )


def paper_task(task: str) -> str | None:
    """The paper's task that a task of ours is like; None if it is like neither.

    Examples:
        >>> paper_task("water_near"), paper_task("trap")
        ('water', None)
    """
    return _known_as("tasks", task)


def paper_method(method: str) -> str | None:
    """What the paper calls a method of ours; None if it has none like it.

    Examples:
        >>> paper_method("gppo"), paper_method("soft_ppo")
        ('GPPO', None)
    """
    return _known_as("methods", method.lower())


def paper_curves(task: str) -> list[PaperCurve]:
    """The curves of Figure 2 that belong to a task of ours.

    Examples:
        >>> [curve.method for curve in paper_curves("indoor_paper")]
        ['GRainbow', 'Rainbow']
    """
    return [
        PaperCurve(
            curve["method"],
            np.array(curve["agent_episodes"], dtype=np.float64),
            np.array(curve["success_percent"]) / 100.0,
        )
        for curve in paper()["curves"]
        if curve["task"] == paper_task(task)
    ]


def paper_table(task: str) -> list[dict[str, Any]]:
    """The rows of Table 1 that belong to a task of ours.

    Examples:
        >>> [(row["method"], row["steps"]) for row in paper_table("water")]
        [('PPO', 98), ('GPPO', 89)]
    """
    return [row for row in paper()["table"] if row["task"] == paper_task(task)]


def _known_as(kind: str, ours: str) -> str | None:
    return next((name for name, known in paper()[kind].items() if ours in known), None)
