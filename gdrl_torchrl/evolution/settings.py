"""What a population beside the agent can be told."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import ClassVar

from gdrl_torchrl.checks import (
    MOST_EPISODES,
    MOST_STEPS,
    MOST_WORLDS,
    among,
    check_choice,
    check_evaluation_worlds,
    check_fields,
    check_folder,
    limits,
    within,
)
from gdrl_torchrl.plugins import with_plugins

# The functions are in ``gdrl_torchrl.evolution``, which imports torch: that takes seconds,
# and a wrong option is answered before.
CROSSOVERS = ("none", "n_point")
MUTATIONS = ("bernoulli", "pseudocode", "scaled")
TIE_RULES = ("return_then_parent", "parent", "child")
_MOST_TRIALS = 10_000
_KEEP_OR_RESET = ("keep", "reset")
_GOALS_OR_RETURN = ("goals", "return")
_GREEDY_OR_SAMPLED = ("greedy", "sampled")


@dataclasses.dataclass
class EvolutionConfig:
    """The genetic evaluation of the agent (Marchesini and Farinelli, AAMAS 2020)."""

    name: str = "genetic"
    """What runs with these settings are called."""
    enabled: bool = True
    """Whether populations are evaluated at all."""
    num_children: int = within(10, least=1, most=MOST_WORLDS)
    """Mutated copies of the agent in a population."""
    num_trials: int = within(10, least=1, most=_MOST_TRIALS)
    """Episodes that every member is scored on; with ``contest=paired`` only the number
    that goals are counted per."""
    period_episodes: int = within(50, least=1, most=MOST_EPISODES)
    """Completed training episodes between evaluations; not given by the papers."""
    mutation: str = "bernoulli"
    """How children are made; ``bernoulli`` changes each weight with a probability of
    ``rates``."""
    mut_v: float = within(0.1, least=0.0, most=10.0)
    """How far a mutation goes, in weight units."""
    mut_v_is: str = among("std", ("std", "variance"))
    """Whether ``mut_v`` is the standard deviation of the noise or its variance."""
    rates: list[float] = dataclasses.field(
        default_factory=lambda: [0.75, 0.4, 0.1],
        metadata=limits(lengths=(1, 100), least=0.0, most=1.0),
    )
    """Probabilities of a mutation, from the beginning on; the next one comes with each of
    ``thresholds``."""
    thresholds: list[float] = dataclasses.field(
        default_factory=lambda: [0.4, 0.8],
        metadata=limits(lengths=(0, 99), least=0.0, most=1.0),
    )
    """Success rates at which the next of ``rates`` begins; not given by the papers."""
    crossover: str = "none"
    """Of children, after their mutation."""
    num_points: int = within(2, least=1, most=1000)
    """Cuts of ``crossover=n_point``."""
    divergence: float | None = within(None, least=0.001, most=10.0)
    """Safe mutations: how far the outputs of every child are from the agent's, root mean
    square, in standard deviations of the agent's. None scales no mutation."""
    divergence_rows: int = within(256, least=1, most=1_000_000)
    """Observations of the last batch that this is measured over."""
    window_episodes: int = within(100, least=1, most=MOST_EPISODES)
    """Last training episodes that success is measured over."""
    success_range: list[float] = dataclasses.field(
        default_factory=lambda: [0.0, 1.0],
        metadata=limits(lengths=(2, 2), least=0.0, most=1.0),
    )
    """Success of the window, both ends included, outside which an evaluation that is due
    waits. Contests cost most where members fail, and give nothing where all succeed."""
    fitness: str = among("goals", _GOALS_OR_RETURN)
    """What members are scored by: ``goals`` that they reach, or the mean ``return``."""
    contest: str = among("full", ("full", "paired", "copies", "random"))
    """``full``: all over the same episodes, the best wins; ``paired``: a child must win
    a test against the agent; ``copies``: none, the agent alone plays as many episodes as
    its population would, and stays; ``random``: all play, and one of them is drawn."""
    screening_trials: int = within(3, least=1, most=_MOST_TRIALS)
    """With ``contest=paired``: episodes of a round, after which half the children go."""
    test_trials: int = within(10, least=1, most=_MOST_TRIALS)
    """With ``contest=paired``: episodes between looks at the test."""
    num_looks: int = within(2, least=1, most=100)
    """With ``contest=paired``: looks, after which the agent stays."""
    level: float = within(0.2, above=0.0, below=1.0)
    """With ``contest=paired``: probability that a child no better than the agent wins."""
    own_share: float = within(0.0, least=0.0, below=1.0)
    """Share of its own weights that the agent keeps on a switch."""
    act: str = among("greedy", _GREEDY_OR_SAMPLED)
    """How members act: ``greedy``, or ``sampled`` as the agent does in training."""
    rate_of: str = among("window", ("window", "contest"))
    """What ``thresholds`` are for: success of the agent in the ``window``, or of its copy
    in the last ``contest``."""
    genome: str = among("all", ("all", "head", "advantage"))
    """Weights that mutate: ``all``; the policy's last layer (``head``); or Rainbow's stream
    of ``advantage``, its last layers included. The other two keep estimates of values."""
    tie_rule: str = among("return_then_parent", TIE_RULES)
    """Who wins among equals: the higher return and then the agent, the agent (``parent``),
    or a ``child``."""
    optimizer_on_switch: str = among("keep", _KEEP_OR_RESET)
    """``keep`` the optimiser's moments or ``reset`` those of the actor."""
    critic_on_switch: str = among("keep", _KEEP_OR_RESET)
    """``keep`` the parent's critic or ``reset`` it to new weights."""
    target_tau: float = within(0.1, least=0.0, most=1.0)
    """How far a target network moves towards the winner on a switch."""
    experience_share: float = within(0.1, least=0.0, most=1.0)
    """Share of an evaluation's transitions that enters the agent's replay buffer; 0
    shares none."""
    share_on: str = among("switch", ("switch", "always"))
    """Whether experience is shared on a ``switch`` only or ``always``."""
    updates_for_shared: bool = False
    """Whether Rainbow makes as many updates for shared transitions as for its own."""
    num_worlds: int | None = within(None, least=1, most=MOST_WORLDS)
    """Worlds of the evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        check_fields(self, "evolution")
        check_folder("evolution.name", self.name)
        _check_operator("crossover", self.crossover, CROSSOVERS)
        _check_operator("mutation", self.mutation, MUTATIONS)
        check_evaluation_worlds("evolution", self, "num_children", 1 + self.num_children)
        if len(self.rates) != len(self.thresholds) + 1:
            raise ValueError(
                f"evolution.rates={self.rates} must have one entry more than "
                f"evolution.thresholds={self.thresholds}"
            )
        if self.thresholds != sorted(set(self.thresholds)):
            raise ValueError(f"evolution.thresholds={self.thresholds} must increase")
        if self.success_range != sorted(self.success_range):
            raise ValueError(
                f"evolution.success_range={self.success_range} must not decrease"
            )
        # The test draws thousands of signs for each of its episodes, all at once.
        if self.test_trials * self.num_looks > _MOST_TRIALS:
            raise ValueError(
                f"evolution.test_trials={self.test_trials} times "
                f"evolution.num_looks={self.num_looks} must be <= {_MOST_TRIALS}"
            )


@dataclasses.dataclass
class ErlConfig:
    """Evolutionary RL (Khadka and Tumer 2018, https://arxiv.org/abs/1805.07917)."""

    name: str = "erl"
    """What runs with these settings are called."""
    enabled: bool = True
    """Whether populations are evaluated at all."""
    population_size: int = within(10, least=3, most=MOST_WORLDS)
    """Members, of which one is a copy of the agent after each synchronisation."""
    num_trials: int = within(3, least=1, most=_MOST_TRIALS)
    """Episodes that every member is scored on."""
    period_episodes: int = within(8, least=1, most=MOST_EPISODES)
    """Completed training episodes between generations: 2,000 over the 250 evaluations
    that AAMAS 2020 reports."""
    num_elites: int = within(2, least=1, most=MOST_WORLDS)
    """Best members that stay as they are."""
    tournament_size: int = within(3, least=1, most=1000)
    """Members of which the best becomes a parent."""
    mutation_probability: float = within(0.9, least=0.0, most=1.0)
    """Of a member that is no elite."""
    sync_period: int = within(1, least=1, most=MOST_EPISODES)
    """Generations between copies of the agent."""
    window_episodes: int = within(100, least=1, most=MOST_EPISODES)
    """Last training episodes that success is measured over."""
    fitness: str = among("goals", _GOALS_OR_RETURN)
    """What members are scored by: ``goals`` that they reach, or the mean ``return``."""
    act: str = among("greedy", _GREEDY_OR_SAMPLED)
    """How members act: ``greedy``, or ``sampled`` as the agent does in training."""
    experience_share: float = within(1.0, least=0.0, most=1.0)
    """Share of a generation's transitions that enters the agent's replay buffer."""
    updates_for_shared: bool = False
    """Whether Rainbow makes as many updates for shared transitions as for its own."""
    num_worlds: int | None = within(None, least=1, most=MOST_WORLDS)
    """Worlds of an evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        check_fields(self, "evolution")
        check_folder("evolution.name", self.name)
        check_evaluation_worlds("evolution", self, "population_size", self.population_size)
        if self.num_elites > self.population_size - 2:
            raise ValueError(
                f"evolution.num_elites={self.num_elites} must be <= "
                f"evolution.population_size={self.population_size} less 2: one member is "
                "new and one is the agent's copy"
            )


@dataclasses.dataclass
class RaceConfig:
    """Races of large mutations while the agent fails, in place of contests at any time."""

    fitness: ClassVar[str] = "goals"
    """What members are scored by: a race needs episodes that succeed or do not."""

    name: str = "race"
    """What runs with these settings are called."""
    enabled: bool = True
    """Whether populations are evaluated at all."""
    num_members: int = within(16, least=1, most=MOST_WORLDS)
    """Members of a round, each of which plays one episode."""
    num_distilled: int = within(6, least=0, most=MOST_WORLDS)
    """Members of a round that are distilled from episodes which reached the goal."""
    num_again: int = within(4, least=0, most=MOST_WORLDS)
    """Members of a round, at most, that have played and reached the goal."""
    num_trials: int = within(8, least=1, most=_MOST_TRIALS)
    """Episodes of the test that a candidate must pass to become the agent."""
    least_success: float = within(0.6, above=0.0, most=1.0)
    """Success in the test that is enough at first."""
    halving_steps: int = within(40_000, least=1, most=MOST_STEPS)
    """Steps of a race in which this falls to its half, again and again."""
    act: str = among("sampled", _GREEDY_OR_SAMPLED)
    """How members act: as the agent does in training, or greedily."""
    race_below: float = within(0.1, least=0.0, most=1.0)
    """Success of the agent in training under which races are run."""
    patience_episodes: int = within(30, least=1, most=MOST_EPISODES)
    """Training episodes after a candidate became the agent before races may go on."""
    share: float = within(0.9, least=0.0, below=1.0)
    """Share of all steps that races take while they are run."""
    new_std: float = within(0.86, least=0.0, most=10.0)
    """Standard deviation of the mutation that makes new members of the first weights."""
    new_rate: float = within(0.75, least=0.0, most=1.0)
    """Probability that it changes a weight."""
    distillation_updates: int = within(600, least=1, most=100_000)
    """Updates that each distilled member is made with."""
    most_candidates: int = within(16, least=1, most=MOST_WORLDS)
    """Members with a success that are kept between rounds."""
    hand_over: str = among("tested", ("tested", "random"))
    """Who becomes the agent: the candidate that was ``tested``, or, as a control, one that
    is drawn at ``random`` in its place."""
    window_episodes: int = within(50, least=20, most=MOST_EPISODES)
    """Last training episodes that success is measured over."""
    num_worlds: int | None = within(None, least=1, most=MOST_WORLDS)
    """Worlds of the evaluation; None takes one per member."""

    def __post_init__(self) -> None:
        check_fields(self, "evolution")
        check_folder("evolution.name", self.name)


EVOLUTIONS: dict[str, type] = {
    "evolution": EvolutionConfig,
    "erl": ErlConfig,
    "race": RaceConfig,
}
"""The dataclasses that ``conf/evolution`` files are made of."""


def _check_operator(name: str, value: str, own: Collection[str]) -> None:
    """Raise ValueError unless an operator is ours or another package's."""
    # Those of other packages are imported only if one of them is asked for.
    if value not in own:
        offered = with_plugins(dict.fromkeys(own), f"gdrl.{name}s")
        check_choice(f"evolution.{name}", value, offered)
