"""``AttachedRaceHook``: a race whose options come before there is an agent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torchrl.envs import EnvBase
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl.evolution.hooks.attach import check_local, find_policy
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.population.rules import exploration_of
from gdrl_torchrl.evolution.race.hook import RaceHook
from gdrl_torchrl.evolution.settings import RaceConfig


class AttachedRaceHook(TrainerHookBase):
    """A race for the policy of any trainer of TorchRL that has one in its loss.

    Args:
        create_env_fn: Makes the environment that members play in, which has a flag
            ``success``: see :class:`~gdrl_torchrl.envs.success.ReturnSuccess`. The
            trainer's own environment must have the flag too.
        max_steps: Steps after which an episode of a member is cut off; None waits for its
            end.
        seed: Seed of the mutations and of the members' episodes.
        on_evaluation: Called with each
            :class:`~gdrl_torchrl.evolution.hooks.base.GeneticEvaluation`.
        **settings: Fields of :class:`~gdrl_torchrl.evolution.settings.RaceConfig`.

    Attributes:
        race: The hook that was made, None before :meth:`register`.

    Raises:
        ValueError: If a setting is out of range.
        TypeError: If there is no such setting.

    Examples:
        >>> from torchrl.envs import Compose, GymEnv, RewardSum, TransformedEnv
        >>> from gdrl_torchrl.envs.success import ReturnSuccess
        >>> def make_env():
        ...     flag = Compose(RewardSum(), ReturnSuccess(400.0))
        ...     return TransformedEnv(GymEnv("CartPole-v1"), flag)
        >>> hook = AttachedRaceHook(create_env_fn=make_env, num_distilled=0)
        >>> hook.race is None
        True
    """

    def __init__(
        self,
        *,
        create_env_fn: Callable[[], EnvBase],
        max_steps: int | None = None,
        seed: int = 0,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
        **settings: Any,
    ) -> None:
        self.settings = RaceConfig(**settings)
        self.race: RaceHook | None = None
        self.seed, self.on_evaluation = seed, list(on_evaluation)
        self._create_env_fn, self._max_steps = create_env_fn, max_steps

    def register(self, trainer: Any, name: str = "race_hook") -> None:
        """Find the trainer's policy and register a :class:`RaceHook` of it.

        Raises:
            ValueError: If the loss has no policy that learns, the trainer collects
                asynchronously or learns in other processes, or the policy cannot be
                distilled.
        """
        check_local(trainer)
        actor = getattr(trainer.loss_module, find_policy(trainer.loss_module))
        evaluator = PopulationEvaluator(
            actor,
            num_episodes=self.settings.num_trials,
            create_env_fn=self._create_env_fn,
            max_steps=self._max_steps,
            fitness=self.settings.fitness,
            seed=self.seed,
            exploration_type=exploration_of(self.settings.act),
        )
        race = RaceHook(
            actor,
            evaluator,
            self.settings,
            optimizer=trainer.optimizer,
            seed=self.seed,
            on_evaluation=self.on_evaluation,
        )
        race.register(trainer, name)
        self.race = race

    def state_dict(self) -> dict[str, Any]:
        """State of the hook that was made; the trainer's own state has it as well."""
        return self._registered().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self._registered().load_state_dict(state_dict)

    def _registered(self) -> RaceHook:
        if self.race is None:
            raise RuntimeError("there is no state before register(trainer)")
        return self.race
