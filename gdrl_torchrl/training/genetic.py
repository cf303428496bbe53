"""``GeneticHook``: the periodic genetic evaluation, as a hook for any TorchRL trainer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.trainers import Trainer
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.genome import concatenate, genome_of, install, stack_copies
from gdrl_torchrl.evolution.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.schedule import MutationSchedule, SuccessWindow
from gdrl_torchrl.evolution.selection import select_best
from gdrl_torchrl.transforms.population_evaluator import PopulationEvaluator

Mutation = Callable[..., TensorDictBase]
PARENT = 0


@dataclasses.dataclass(frozen=True)
class GeneticEvaluation:
    """What one genetic evaluation found; the parent's copy is member 0."""

    number: int
    mut_p: float
    scores: TensorDictBase
    """Result of the evaluator, ``[1 + N]``."""
    winner: int
    population_steps: int

    @property
    def switched(self) -> bool:
        """Whether a child replaced the agent."""
        return self.winner != PARENT


class GeneticHook(TrainerHookBase):
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
        window_episodes: Training episodes that the success rate is over.
        tie_rule: Who wins among equals, see
            :func:`~gdrl_torchrl.evolution.selection.select_best`.
        optimizer: Optimiser whose moments of the actor ``optimizer_on_switch`` is about.
        optimizer_on_switch: ``keep`` or ``reset`` those moments on a switch.
        critic: Critic that ``critic_on_switch`` is about.
        critic_on_switch: ``keep`` the parent's critic or ``reset`` its layers.
        on_switch: Called after the agent was replaced, as to move a target network.
        share_experience: Called on a switch with the transitions ``[T]`` of the
            evaluation (whole episodes, one after another); without it they are not kept.
        seed: Seed of the mutations.
        success_key: Flag of success in the training batches.
        on_evaluation: Called with each :class:`GeneticEvaluation`.

    Raises:
        ValueError: If ``num_children`` or ``period_episodes`` < 1, or something is to
            be reset that was not given.
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
        window_episodes: int = 100,
        tie_rule: str = "return_then_parent",
        optimizer: torch.optim.Optimizer | None = None,
        optimizer_on_switch: str = "keep",
        critic: torch.nn.Module | None = None,
        critic_on_switch: str = "keep",
        on_switch: Sequence[Callable[[], object]] = (),
        share_experience: Callable[[TensorDictBase], object] | None = None,
        seed: int = 0,
        success_key: str = keys.SUCCESS,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        for name, value in (
            ("num_children", num_children),
            ("period_episodes", period_episodes),
        ):
            if value is not None and value < 1:
                raise ValueError(f"{name}={value} must be >= 1")
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
        self.actor = actor
        self.evaluator = evaluator
        self.num_children = num_children
        self.period_episodes = period_episodes
        self.mutation = mutation
        self.std = std
        self.schedule = schedule or MutationSchedule()
        self.window = SuccessWindow(window_episodes)
        self.tie_rule = tie_rule
        self.optimizer = optimizer
        self.optimizer_on_switch = optimizer_on_switch
        self.critic = critic
        self.critic_on_switch = critic_on_switch
        self.on_switch = list(on_switch)
        self.share_experience = share_experience
        self.success_key = success_key
        self.on_evaluation = list(on_evaluation)
        self.generator = torch.Generator().manual_seed(seed)
        self.num_evaluations = 0
        self.num_switches = 0
        self.population_steps = 0
        self.episodes_completed = 0
        self._episodes_at_evaluation = 0
        self._last_episode = -1
        self._trainer: Trainer | None = None

    def register(self, trainer: Trainer, name: str = "genetic_hook") -> None:
        """Register with a trainer: batches are observed, evaluations follow updates."""
        self._trainer = trainer
        trainer.register_module(name, self)
        trainer.register_op("batch_process", self.observe)
        trainer.register_op("post_steps", self)

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """Count a batch's ended episodes and note their success, in starting order.

        Args:
            batch: Collected transitions ``[T]`` or ``[W, T]`` with ``episode_number``
                of the environment or, without it, the collector's trajectory ids.

        Returns:
            The batch itself.
        """
        done = batch["next", keys.DONE].reshape(-1)
        episode = batch.get(keys.EPISODE_NUMBER, None)
        if episode is None:
            episode = batch["collector", "traj_ids"]
        episode = episode.reshape(-1)
        self._note_starts(episode.unique().tolist())
        ended = episode[done]
        success = batch.get(("next", self.success_key), None)
        if success is None:
            flags = torch.zeros(len(ended), dtype=torch.bool)
        else:
            flags = success.reshape(-1)[done]
        for number, flag in zip(ended.tolist(), flags.tolist(), strict=True):
            self.window.finish(number, flag)
        self.episodes_completed += len(ended)
        return batch

    def _note_starts(self, episodes: list[int]) -> None:
        known = (n for n in episodes if n <= self._last_episode)
        if not all(self.window.is_open(number) for number in known):
            # An episode that had ended is back: numbers begin anew, as after a restart
            # with new episodes, and those that were running are gone.
            self.window.forget_running()
            self._last_episode = -1
        begun = [number for number in episodes if number > self._last_episode]
        self.window.begin(begun)
        if begun:
            self._last_episode = begun[-1]

    def __call__(self) -> None:
        """Evaluate if enough episodes have ended since the last evaluation."""
        if self.period_episodes is None:
            return
        since = self.episodes_completed - self._episodes_at_evaluation
        if since >= self.period_episodes:
            self._episodes_at_evaluation = self.episodes_completed
            self.evaluate()

    def evaluate(self) -> GeneticEvaluation:
        """Make children, score them with the agent's copy, install the winner."""
        genome = genome_of(self.actor)
        mut_p = self.schedule(self.window.rate)
        children = self.mutation(
            stack_copies(genome, self.num_children),
            mut_p=mut_p,
            std=self.std,
            generator=self.generator,
        )
        population = concatenate([stack_copies(genome, 1), children])
        transitions = None
        if self.share_experience is None:
            scores = self.evaluator.evaluate(population)
        else:
            scores, transitions = self.evaluator.evaluate_with_transitions(population)
        winner = select_best(scores, parent=PARENT, tie_rule=self.tie_rule)
        evaluation = GeneticEvaluation(
            number=self.num_evaluations,
            mut_p=mut_p,
            scores=scores,
            winner=winner,
            population_steps=int(scores[keys.FRAMES].sum()),
        )
        self.num_evaluations += 1
        self.population_steps += evaluation.population_steps
        if evaluation.switched:
            self.num_switches += 1
            self._hand_over(population[winner])
            if self.share_experience is not None:
                self.share_experience(transitions)
        for callback in self.on_evaluation:
            callback(evaluation)
        return evaluation

    def _hand_over(self, genome: TensorDictBase) -> None:
        install(self.actor, genome)
        if self.optimizer_on_switch == "reset":
            assert self.optimizer is not None
            for parameter in self.actor.parameters():
                self.optimizer.state.pop(parameter, None)
        if self.critic_on_switch == "reset":
            assert self.critic is not None
            for module in self.critic.modules():
                reset = getattr(module, "reset_parameters", None)
                if callable(reset):
                    reset()
        for follow in self.on_switch:
            follow()
        if self._trainer is not None:
            # Collectors in other processes hold copies of the weights.
            collector: Any = self._trainer.collector
            collector.update_policy_weights_()

    def state_dict(self) -> dict[str, Any]:
        """Window, counters and generators."""
        return {
            "window": self.window.state_dict(),
            "generator": self.generator.get_state(),
            "fitness_episodes": self.evaluator.num_evaluations,
            "num_evaluations": self.num_evaluations,
            "num_switches": self.num_switches,
            "population_steps": self.population_steps,
            "episodes_completed": self.episodes_completed,
            "episodes_at_evaluation": self._episodes_at_evaluation,
            "last_episode": self._last_episode,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.window.load_state_dict(state_dict["window"])
        self.generator.set_state(state_dict["generator"])
        self.evaluator.num_evaluations = state_dict["fitness_episodes"]
        self.num_evaluations = state_dict["num_evaluations"]
        self.num_switches = state_dict["num_switches"]
        self.population_steps = state_dict["population_steps"]
        self.episodes_completed = state_dict["episodes_completed"]
        self._episodes_at_evaluation = state_dict["episodes_at_evaluation"]
        self._last_episode = state_dict["last_episode"]
