"""What a report is about: runs by task and method, whatever they were read from."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from functools import cached_property

import numpy as np

from gdrl_torchrl.reports.statistics.comparisons import Alternative

COSTS = ("agent_episodes", "total_steps", "wall_s")
"""What success is drawn over."""


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """One run.

    Attributes:
        seed: Its seed.
        origin: What it was made of: its configuration, code and folder, in words.
        failed: Whether it ended with an error; then its score and success are 0.
        score: What methods are compared by.
        numbers: Final success and costs by name; what is unknown is missing, as are the
            costs of a run that failed.
        curve: Success over what it cost, columns ``[K]`` by name; empty if there is none,
            or the run failed.
        elsewhere: Success of its final policy in other worlds, by their name.
    """

    seed: int
    origin: str
    failed: bool
    score: float
    numbers: Mapping[str, float]
    curve: Mapping[str, np.ndarray]
    elsewhere: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, eq=False)
class Arm:
    """The runs of a method on a task.

    Attributes:
        task: The task.
        method: The method.
        runs: In the order of their seeds.
        missing: Seeds of the protocol that have not run.
        configurations: Keys of what its runs were made with, where these are known.
    """

    task: str
    method: str
    runs: tuple[Run, ...]
    missing: tuple[int, ...] = ()
    configurations: tuple[str, ...] = ()

    @cached_property
    def scores(self) -> np.ndarray:
        """Score of every run, ``[N]``."""
        return np.array([run.score for run in self.runs])

    def column(self, name: str) -> np.ndarray:
        """A number of all runs that know it, ``[M]``."""
        return np.array([run.numbers[name] for run in self.runs if name in run.numbers])

    def mean(self, name: str) -> float:
        """Mean of a number over the runs that know it; NaN if none does."""
        values = self.column(name)
        return float(values.mean()) if len(values) else math.nan


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """A comparison that was registered before the runs.

    Attributes:
        name: Its name.
        task: Where.
        method: What is thought to be better.
        against: Than what.
        alternative: ``greater``, ``less``, or ``two-sided`` where it is only thought to
            differ.
        least_difference: The least difference of mean scores that would matter.
    """

    name: str
    task: str
    method: str
    against: str
    alternative: Alternative
    least_difference: float


@dataclasses.dataclass(frozen=True)
class Words:
    """What the numbers of a report are called.

    Attributes:
        score: What methods are compared by, in a sentence.
        score_name: The same as the head of a column.
        curve: What curves show, as the label of an axis.
    """

    score: str
    score_name: str
    curve: str


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """All that a report is made of.

    Attributes:
        title: Of the page.
        question: What shall be found out; empty if nobody said.
        words: What the numbers are called.
        facts: Names and values: the protocol, what was run, where it comes from.
        remarks: Sentences on what is missing or was left out.
        sources: Commands and hashes that every figure comes from; those of its runs are
            with the arms.
        arms: Runs by task and method.
        hypotheses: Those that were registered.
        alpha: Level of the tests of all hypotheses together.
        baselines: By task, the method that others are shown beside.
    """

    title: str
    question: str
    words: Words
    facts: tuple[tuple[str, str], ...]
    remarks: tuple[str, ...]
    sources: tuple[str, ...]
    arms: tuple[Arm, ...]
    hypotheses: tuple[Hypothesis, ...] = ()
    alpha: float = 0.05
    baselines: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @cached_property
    def tasks(self) -> tuple[str, ...]:
        """Tasks in the order of the arms."""
        return tuple(dict.fromkeys(arm.task for arm in self.arms))

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """Methods in the order of the arms."""
        return tuple(dict.fromkeys(arm.method for arm in self.arms))

    def on(self, task: str) -> Evidence:
        """The runs on one task, without hypotheses: these are tested all together."""
        arms = tuple(arm for arm in self.arms if arm.task == task)
        return dataclasses.replace(self, arms=arms, hypotheses=())

    def of_methods(self, methods: Collection[str]) -> Evidence:
        """The runs of some methods and of their tasks' baselines, without hypotheses."""
        tasks = {arm.task for arm in self.arms if arm.method in methods}
        arms = tuple(
            arm
            for arm in self.arms
            if arm.method in methods
            or (arm.task in tasks and self.baselines.get(arm.task) == arm.method)
        )
        return dataclasses.replace(self, arms=arms, hypotheses=())

    def of_task(self, task: str) -> tuple[Arm, ...]:
        """The arms of a task that have runs."""
        return tuple(arm for arm in self.arms if arm.task == task and arm.runs)

    def arm(self, task: str, method: str) -> Arm:
        """The arm of a method on a task; one without runs if there is none."""
        found = (arm for arm in self.arms if (arm.task, arm.method) == (task, method))
        return next(found, Arm(task, method, ()))

    def sources_of(self, tasks: Collection[str]) -> tuple[str, ...]:
        """What a figure on some tasks comes from, with the configurations of its runs."""
        made = []
        for task in tasks:
            known = [arm for arm in self.of_task(task) if arm.configurations]
            if known:
                arms = (f"{arm.method} {' '.join(arm.configurations)}" for arm in known)
                made.append(f"configurations on {task}: {', '.join(arms)}")
        return (*self.sources, *made)

    def on_all_tasks(self) -> tuple[str, ...]:
        """Methods that have runs on every task: only they can be averaged over tasks."""
        return tuple(
            m for m in self.methods if all(self.arm(t, m).runs for t in self.tasks)
        )
