"""What a study is: fixed before it is run, and known by a digest from then on."""

from __future__ import annotations

import dataclasses

from gdrl_torchrl.checks import (
    MOST_EPISODES,
    MOST_SEED,
    MOST_STEPS,
    among,
    check_choice,
    check_fields,
    check_folder,
    limits,
    within,
)


@dataclasses.dataclass
class StudyMethod:
    """A method and the tasks that it is tried on."""

    tasks: list[str] = dataclasses.field(default_factory=list)
    """Names of tasks of the study."""
    overrides: list[str] = dataclasses.field(default_factory=list)
    """What makes a run one of this method, as on the command line."""

    def __post_init__(self) -> None:
        check_fields(self, "study.methods")


@dataclasses.dataclass
class Hypothesis:
    """What is expected of a method, registered before it is run."""

    name: str = "hypothesis"
    """Its name in reports."""
    task: str = ""
    """A task of the study."""
    method: str = ""
    """A method of the study."""
    against: str = ""
    """The method that it is compared with."""
    alternative: str = among("two-sided", ("two-sided", "greater", "less"))
    """Whether the method is expected to be better (``greater``), worse, or either."""
    least_difference: float = within(0.0, least=0.0, most=1.0)
    """Difference of the metric that would matter."""

    def __post_init__(self) -> None:
        check_fields(self, "study.hypotheses")


@dataclasses.dataclass
class StudyConfig:
    """Methods, tasks and seeds at equal total steps, judged on held-out worlds.

    Examples:
        >>> StudyConfig(tasks={"near": ["task=water"]}, methods={})
        Traceback (most recent call last):
        ValueError: study.methods={} must not be empty
    """

    name: str = "study"
    """Folder of its results, and first part of the names of its runs."""
    question: str = ""
    """What it is to find out."""
    tasks: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    """Overrides that make a run one of a task, by the task's name."""
    methods: dict[str, StudyMethod] = dataclasses.field(default_factory=dict)
    """Methods by name."""
    total_steps: dict[str, int] = dataclasses.field(
        default_factory=dict, metadata=limits(least=1, most=MOST_STEPS)
    )
    """Budget of each run on a task: steps of agent and populations."""
    seeds: list[int] = dataclasses.field(
        default_factory=lambda: [0],
        metadata=limits(lengths=(1, 10_000), least=0, most=MOST_SEED),
    )
    """Seeds that each method is trained with on each of its tasks."""
    num_policies: int = within(20, least=1, most=1000)
    """Policies of a run, at equal steps of its budget, whose held-out success is the curve
    under which the area is the primary metric."""
    episodes: int = within(500, least=1, most=MOST_EPISODES)
    """Held-out episodes of each of these policies, and of the last one."""
    evaluation_seed: int = within(0, least=0, most=MOST_SEED)
    """Seed of the held-out worlds."""
    metric: str = among("area", ("area", "success_rate"))
    """Primary metric: the ``area`` under the curve of greedy success over total steps, or
    the final ``success_rate``."""
    alpha: float = within(0.05, above=0.0, below=1.0)
    """Level of the tests of all hypotheses together."""
    hypotheses: list[Hypothesis] = dataclasses.field(default_factory=list)
    """What is tested; anything else in a report is a look."""
    baseline: dict[str, str] = dataclasses.field(default_factory=dict)
    """By the task's name, the method that a report shows all others beside, such as the
    bare agent. A look: no hypothesis."""
    elsewhere: dict[str, dict[str, list[str]]] = dataclasses.field(default_factory=dict)
    """Other worlds that the final policies of a task's runs are evaluated on too: by the
    task's name and their own, overrides that make them of the task."""

    def __post_init__(self) -> None:
        check_fields(self, "study")
        check_folder("study.name", self.name)
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"study.seeds={self.seeds} must not hold a seed twice")
        for name in ("tasks", "methods"):
            if not getattr(self, name):
                raise ValueError(f"study.{name}={{}} must not be empty")
        for task in self.tasks:
            check_folder("study.tasks", task)
            check_choice("a task in study.total_steps", task, self.total_steps)
        for name, method in self.methods.items():
            self._check_method(name, method)
        for hypothesis in self.hypotheses:
            self._check(hypothesis)
        for task, method in self.baseline.items():
            check_choice("a task in study.baseline", task, self.tasks)
            check_choice(f"study.baseline.{task}", method, self._methods_on(task))
        for task, worlds in self.elsewhere.items():
            self._check_worlds(task, worlds)

    def _check_method(self, name: str, method: StudyMethod) -> None:
        check_folder("study.methods", name)
        if not method.tasks:
            raise ValueError(f"study.methods.{name}.tasks=[] must not be empty")
        for task in method.tasks:
            check_choice(f"study.methods.{name}.tasks", task, self.tasks)

    def _check_worlds(self, task: str, worlds: dict[str, list[str]]) -> None:
        check_choice("a task in study.elsewhere", task, self.tasks)
        for name in worlds:
            check_folder(f"study.elsewhere.{task}", name)

    def _check(self, hypothesis: Hypothesis) -> None:
        start = f"study.hypotheses: {hypothesis.name}"
        check_choice(f"{start}.task", hypothesis.task, self.tasks)
        for field in ("method", "against"):
            on_task = self._methods_on(hypothesis.task)
            check_choice(f"{start}.{field}", getattr(hypothesis, field), on_task)

    def _methods_on(self, task: str) -> list[str]:
        return [name for name, method in self.methods.items() if task in method.tasks]
