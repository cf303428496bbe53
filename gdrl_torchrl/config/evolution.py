"""What a population beside the agent can be told."""

from __future__ import annotations

import dataclasses

from gdrl_torchrl.config.checks import check_choice, check_folder, check_range


@dataclasses.dataclass
class EvolutionConfig:
    """The genetic evaluation of the agent (Marchesini and Farinelli, AAMAS 2020)."""

    name: str = "genetic"
    """What runs with these settings are called."""
    enabled: bool = True
    num_children: int = 10
    num_trials: int = 10
    """Episodes that every member is scored on; with ``contest=paired`` only the number
    that goals are counted per."""
    period_episodes: int = 50
    """Completed training episodes between evaluations; not given by the papers."""
    mutation: str = "bernoulli"
    mut_v: float = 0.1
    mut_v_is: str = "std"
    rates: list[float] = dataclasses.field(default_factory=lambda: [0.75, 0.4, 0.1])
    thresholds: list[float] = dataclasses.field(default_factory=lambda: [0.4, 0.8])
    """Success rates at which the next of ``rates`` begins; not given by the papers."""
    crossover: str = "none"
    """Of children, after their mutation."""
    num_points: int = 2
    """Cuts of ``crossover=n_point``."""
    sensitivity: bool = False
    """Whether mutations are divided by how much the outputs depend on each weight."""
    sensitivity_rows: int = 256
    """Observations that this is measured over."""
    window_episodes: int = 100
    fitness: str = "goals"
    contest: str = "full"
    """``full``: all over the same episodes, the best wins; ``paired``: a child must win
    a test against the agent; ``copies``: none, the agent alone plays as many episodes as
    its population would, and stays."""
    screening_trials: int = 3
    """With ``contest=paired``: episodes of a round, after which half the children go."""
    test_trials: int = 10
    """With ``contest=paired``: episodes between looks at the test."""
    num_looks: int = 2
    """With ``contest=paired``: looks, after which the agent stays."""
    level: float = 0.2
    """With ``contest=paired``: probability that a child no better than the agent wins."""
    own_share: float = 0.0
    """Share of its own weights that the agent keeps on a switch."""
    tie_rule: str = "return_then_parent"
    optimizer_on_switch: str = "keep"
    """``keep`` the optimiser's moments or ``reset`` those of the actor."""
    critic_on_switch: str = "keep"
    """``keep`` the parent's critic or ``reset`` it to new weights."""
    target_tau: float = 0.1
    """How far a target network moves towards the winner on a switch."""
    experience_share: float = 0.1
    """Share of an evaluation's transitions that enters the agent's replay buffer; 0
    shares none."""
    share_on: str = "switch"
    """Whether experience is shared on a ``switch`` only or ``always``."""
    num_worlds: int | None = None
    """Worlds of the evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        # Here because they import torch, which takes seconds: --help needs no torch.
        from gdrl_torchrl.evolution.crossover import crossovers
        from gdrl_torchrl.evolution.mutation import mutations
        from gdrl_torchrl.evolution.selection import TIE_RULES

        check_folder("evolution.name", self.name)
        for name in (
            "num_children",
            "num_trials",
            "period_episodes",
            "window_episodes",
            "num_points",
            "sensitivity_rows",
            "screening_trials",
            "test_trials",
            "num_looks",
        ):
            check_range(f"evolution.{name}", getattr(self, name), least=1)
        check_range("evolution.own_share", self.own_share, least=0.0, below=1.0)
        check_range("evolution.level", self.level, above=0.0, below=1.0)
        check_choice("evolution.crossover", self.crossover, crossovers())
        check_choice("evolution.contest", self.contest, ("full", "paired", "copies"))
        check_choice("evolution.share_on", self.share_on, ("switch", "always"))
        if self.num_worlds is not None:
            check_range("evolution.num_worlds", self.num_worlds, least=1)
        check_range("evolution.mut_v", self.mut_v, least=0.0)
        for name in ("target_tau", "experience_share"):
            check_range(f"evolution.{name}", getattr(self, name), least=0.0, most=1.0)
        check_choice("evolution.mutation", self.mutation, mutations())
        check_choice("evolution.mut_v_is", self.mut_v_is, ("std", "variance"))
        check_choice("evolution.fitness", self.fitness, ("goals", "return"))
        check_choice("evolution.tie_rule", self.tie_rule, TIE_RULES)
        for name in ("optimizer_on_switch", "critic_on_switch"):
            check_choice(f"evolution.{name}", getattr(self, name), ("keep", "reset"))
        for name in ("rates", "thresholds"):
            for value in getattr(self, name):
                check_range(f"evolution.{name}", value, least=0.0, most=1.0)
        if len(self.rates) != len(self.thresholds) + 1:
            raise ValueError(
                f"evolution.rates={self.rates} must have one entry more than "
                f"evolution.thresholds={self.thresholds}"
            )
        if self.thresholds != sorted(set(self.thresholds)):
            raise ValueError(f"evolution.thresholds={self.thresholds} must increase")


@dataclasses.dataclass
class ErlConfig:
    """Evolutionary RL (Khadka and Tumer 2018, https://arxiv.org/abs/1805.07917)."""

    name: str = "erl"
    """What runs with these settings are called."""
    enabled: bool = True
    population_size: int = 10
    """Members, of which one is a copy of the agent after each synchronisation."""
    num_trials: int = 3
    """Episodes that every member is scored on."""
    period_episodes: int = 8
    """Completed training episodes between generations: 2,000 over the 250 evaluations
    that the seed reports."""
    num_elites: int = 2
    tournament_size: int = 3
    mutation_probability: float = 0.9
    sync_period: int = 1
    """Generations between copies of the agent."""
    window_episodes: int = 100
    fitness: str = "goals"
    experience_share: float = 1.0
    """Share of a generation's transitions that enters the agent's replay buffer."""
    num_worlds: int | None = None
    """Worlds of an evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        check_folder("evolution.name", self.name)
        for name in (
            "num_trials",
            "period_episodes",
            "tournament_size",
            "sync_period",
            "window_episodes",
        ):
            check_range(f"evolution.{name}", getattr(self, name), least=1)
        check_range("evolution.population_size", self.population_size, least=3)
        most = self.population_size - 2
        check_range("evolution.num_elites", self.num_elites, least=1, most=most)
        for name in ("mutation_probability", "experience_share"):
            check_range(f"evolution.{name}", getattr(self, name), least=0.0, most=1.0)
        check_choice("evolution.fitness", self.fitness, ("goals", "return"))
        if self.num_worlds is not None:
            check_range("evolution.num_worlds", self.num_worlds, least=1)


EVOLUTIONS: dict[str, type] = {"evolution": EvolutionConfig, "erl": ErlConfig}
"""The dataclasses that ``conf/evolution`` files are made of."""
