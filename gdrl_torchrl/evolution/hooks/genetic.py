"""``GeneticHook``: the periodic genetic evaluation, as a hook for any TorchRL trainer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.trainers.trainers import UpdateWeights

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation, PopulationHook
from gdrl_torchrl.evolution.hooks.contest import PARENT, Contest, FullContest
from gdrl_torchrl.evolution.operators.crossover import mean_crossover, no_crossover
from gdrl_torchrl.evolution.operators.genome import (
    concatenate,
    genome_of,
    install,
    stack_copies,
)
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.operators.sensitivity import dampen
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

Mutation = Callable[..., TensorDictBase]
Sensitivity = Callable[[TensorDictBase, torch.Tensor], TensorDictBase]


class GeneticHook(PopulationHook):
    """Every ``period_episodes`` episodes, let mutated children compete with the agent.

    At the first batch boundary after enough training episodes have ended, N children
    are made of the agent by mutation; they and a copy of it are scored over the same
    episodes, and the best one's weights are written into the agent in place: same
    Parameter objects, so the loss, the optimiser and the collector see them
    (Marchesini and Farinelli, AAMAS 2020, section 2.1).

    Args:
        actor: The agent's policy.
        evaluator: Scores populations, in an environment that no collector steps.
        num_children: Children ``N``.
        period_episodes: Training episodes between evaluations; None only watches.
        mutation: ``(genomes [N], mut_p=, std=, generator=) -> genomes [N]``.
        std: Standard deviation of the mutation, in weight units.
        schedule: Mutation probability by success rate.
        crossover: ``(genomes [N], num_points=, generator=) -> genomes [N]``, of the
            mutated children.
        num_points: Cuts of the crossover.
        sensitivity: ``(genome, observations [B, D]) -> genome``: by how much the outputs
            depend on each weight; mutations are divided by it. None leaves them.
        sensitivity_rows: Observations of the last training batch that it is taken over.
        contest: Scores the population and names the winner; by default all members meet
            over the same episodes.
        tie_rule: Who wins among equals in that default contest, see
            :func:`~gdrl_torchrl.evolution.operators.selection.select_best`.
        own_share: Share of its own weights that the agent keeps on a switch: 0 replaces
            it, as in AAMAS 2020; 0.3 is the soft update of Supe-RL (ICLR 2021).
        window_episodes: Training episodes that the success rate is over.
        optimizer: Optimiser whose moments of the actor ``optimizer_on_switch`` is about.
        optimizer_on_switch: ``keep`` or ``reset`` those moments on a switch.
        critic: Critic that ``critic_on_switch`` is about.
        critic_on_switch: ``keep`` the parent's critic or ``reset`` its layers, but for
            those that it shares with the actor: they are the winner's.
        on_switch: Called on a switch, as to move a target network, while the actor has
            the winner's own weights.
        share_experience: Called with the transitions ``[T]`` of the evaluation (whole
            episodes, one after another); without it they are not kept.
        share_always: Whether experience is shared after every evaluation, and not on a
            switch only.
        seed: Seed of the mutations.
        success_key: Flag of success in the training batches.
        on_evaluation: Called with each
            :class:`~gdrl_torchrl.evolution.hooks.base.GeneticEvaluation`.

    Raises:
        ValueError: If ``num_children`` or ``period_episodes`` < 1, ``own_share`` is
            outside [0, 1), something is to be reset that was not given, or a critic is
            that has no layers of its own.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        *,
        num_children: int = 10,
        period_episodes: int | None = 50,
        mutation: Mutation = bernoulli_mutation,
        std: float = 0.1,
        schedule: MutationSchedule | None = None,
        crossover: Mutation = no_crossover,
        num_points: int = 2,
        sensitivity: Sensitivity | None = None,
        sensitivity_rows: int = 256,
        contest: Contest | None = None,
        tie_rule: str = "return_then_parent",
        own_share: float = 0.0,
        window_episodes: int = 100,
        optimizer: torch.optim.Optimizer | None = None,
        optimizer_on_switch: str = "keep",
        critic: torch.nn.Module | None = None,
        critic_on_switch: str = "keep",
        on_switch: Sequence[Callable[[], object]] = (),
        share_experience: Callable[[TensorDictBase], object] | None = None,
        share_always: bool = False,
        seed: int = 0,
        success_key: str = keys.SUCCESS,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        super().__init__(
            actor,
            evaluator,
            period_episodes=period_episodes,
            window_episodes=window_episodes,
            seed=seed,
            success_key=success_key,
            on_evaluation=on_evaluation,
        )
        if num_children < 1:
            raise ValueError(f"num_children={num_children} must be >= 1")
        if not 0.0 <= own_share < 1.0:
            raise ValueError(f"own_share={own_share} must be in [0, 1)")
        for name, value in (
            ("optimizer_on_switch", optimizer_on_switch),
            ("critic_on_switch", critic_on_switch),
        ):
            if value not in ("keep", "reset"):
                raise ValueError(f"{name}={value!r} must be 'keep' or 'reset'")
        if optimizer_on_switch == "reset" and optimizer is None:
            raise ValueError("optimizer_on_switch='reset' needs an optimizer")
        if critic_on_switch == "reset" and critic is None:
            raise ValueError("critic_on_switch='reset' needs a critic")
        self._resets = []
        if critic_on_switch == "reset":
            self._resets = _layers_of_its_own(critic, actor)
        self.num_children = num_children
        self.mutation = mutation
        self.std = std
        self.schedule = schedule or MutationSchedule()
        self.crossover = crossover
        self.num_points = num_points
        self.sensitivity = sensitivity
        self.sensitivity_rows = sensitivity_rows
        self.contest = FullContest(tie_rule) if contest is None else contest
        self.own_share = own_share
        self.optimizer = optimizer
        self.optimizer_on_switch = optimizer_on_switch
        self.critic = critic
        self.critic_on_switch = critic_on_switch
        self.on_switch = list(on_switch)
        self.share_experience = share_experience
        self.share_always = share_always
        self._observations: torch.Tensor | None = None

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """As :meth:`PopulationHook.observe`, and keep what sensitivity is taken over."""
        if self.sensitivity is not None:
            seen = batch[keys.OBSERVATION]
            rows = seen.reshape(-1, seen.shape[-1])
            # Evenly spread over worlds and steps: no random choice is needed.
            stride = max(1, len(rows) // self.sensitivity_rows)
            self._observations = rows[::stride][: self.sensitivity_rows].clone()
        return super().observe(batch)

    def evaluate(self) -> GeneticEvaluation:
        """Make children, score them with the agent's copy, install the winner."""
        genome = genome_of(self.actor)
        mut_p = self.schedule(self.window.rate)
        population = concatenate([stack_copies(genome, 1), self._children(genome, mut_p)])
        verdict = self.contest(
            self.evaluator,
            population,
            generator=self.generator,
            keep_transitions=self.share_experience is not None,
        )
        evaluation = GeneticEvaluation(
            number=self.num_evaluations,
            mut_p=mut_p,
            scores=verdict.scores,
            winner=verdict.winner,
            agent=PARENT,
            switched=verdict.winner != PARENT,
            population_steps=int(verdict.scores[keys.FRAMES].sum()),
        )
        if evaluation.switched:
            self._hand_over(genome, population[verdict.winner])
        if self.share_experience is not None and (evaluation.switched or self.share_always):
            self.share_experience(verdict.transitions)  # pyright: ignore[reportArgumentType]
        return self._note(evaluation)

    def _children(self, genome: TensorDictBase, mut_p: float) -> TensorDictBase:
        copies = stack_copies(genome, self.num_children)
        children = self.mutation(
            copies, mut_p=mut_p, std=self.std, generator=self.generator
        )
        if self.sensitivity is not None:
            if self._observations is None:
                raise RuntimeError("sensitivity needs a training batch: none was observed")
            of_weights = self.sensitivity(genome, self._observations)
            children = dampen(copies, children, of_weights)
        return self.crossover(
            children, num_points=self.num_points, generator=self.generator
        )

    def _hand_over(self, own: TensorDictBase, genome: TensorDictBase) -> None:
        install(self.actor, genome)
        if self.optimizer_on_switch == "reset":
            assert self.optimizer is not None
            for parameter in self.actor.parameters():
                self.optimizer.state.pop(parameter, None)
        for reset in self._resets:
            reset()
        for follow in self.on_switch:
            follow()
        if self.own_share > 0.0:
            install(self.actor, mean_crossover(own, genome, share=self.own_share))
        if self._trainer is not None:
            update_collector(self._trainer)

    def state_dict(self) -> dict[str, Any]:
        """Window, counters, generators and the observations kept."""
        state = super().state_dict()
        if self._observations is not None:
            state["observations"] = self._observations
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self._observations = state_dict.get("observations")


def _layers_of_its_own(critic: Any, actor: torch.nn.Module) -> list[Callable[[], object]]:
    """What resets the layers of a critic that have no parameters of the actor's.

    Raises:
        ValueError: If there are none.
    """
    shared = set(actor.parameters())
    resets = [
        module.reset_parameters
        for module in critic.modules()
        if callable(getattr(module, "reset_parameters", None))
        and shared.isdisjoint(module.parameters())
    ]
    if not resets:
        raise ValueError(
            f"critic_on_switch='reset': {type(critic).__name__} has no layers to reset "
            "that are not the actor's too"
        )
    return resets


def update_collector(trainer: Any) -> None:
    """Give a trainer's collector the weights of the policy, as after every batch.

    Collectors in other processes hold copies, and those of trainers that are made of
    configurations may hold another instance of the policy: only what the trainer itself
    has registered for that knows how. It has had its turn when the hook has its own.
    """
    updates = [
        (operation, options)
        for operation, options in getattr(trainer, "_post_steps_ops", ())
        # TorchRL wraps what is registered to time it.
        if isinstance(getattr(operation, "__wrapped__", operation), UpdateWeights)
    ]
    for operation, options in updates:
        operation(**options)
    if not updates:
        trainer.collector.update_policy_weights_()
