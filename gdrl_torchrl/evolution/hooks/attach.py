"""``AttachedGeneticHook``: a genetic hook whose options come before there is an agent."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation
from gdrl_torchrl.evolution.hooks.breeding import breeding_of
from gdrl_torchrl.evolution.hooks.contest import contest_of
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.hand_over import hand_over_of, move_target
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.population.rules import exploration_of
from gdrl_torchrl.evolution.settings import EvolutionConfig

POLICY_NAMES = ("actor_network", "value_network")
"""Where TorchRL's losses keep the policy; beside an actor, the second is a critic."""


NOT_ATTACHED = (
    *("name", "enabled", "num_worlds", "experience_share", "share_on"),
    *("divergence", "divergence_rows", "critic_on_switch", "updates_for_shared"),
)
"""Settings that need more than a trainer shows: its replay buffer, its worlds, a critic."""
SEQUENCES = ("rates", "thresholds", "success_range")


class AttachedGeneticHook(TrainerHookBase):
    """Options of a :class:`GeneticHook` that is made when it is registered.

    A configuration cannot name the agent's own policy, for every mention of a network
    in it makes another one: the policy is looked for in the trainer's loss.

    Args:
        create_env_fn: Makes the environment that populations are scored in, or is that
            environment; no collector may step it.
        max_steps: Steps after which an episode of fitness is cut off; None waits for its
            end.
        fitness: ``return``, or ``goals`` where the environment has a flag ``success``.
        target_tau: How far the policy's target network, if the loss has one, moves
            towards the winner on a switch: 1 copies it, 0 leaves the target.
        seed: Seed of the mutations and of the fitness episodes.
        on_evaluation: Called with each :class:`GeneticEvaluation`.
        **settings: Fields of
            :class:`~gdrl_torchrl.evolution.settings.EvolutionConfig`, but for
            :data:`NOT_ATTACHED`. Where the environment has no flag of success, children
            are mutated with the first of ``rates``, and with a ``success_range`` from
            above 0 none ever is.

    Attributes:
        genetic: The hook that was made, None before :meth:`register`.

    Raises:
        ValueError: If a setting is out of range.
        TypeError: If there is no such setting.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> hook = AttachedGeneticHook(create_env_fn=lambda: GymEnv("CartPole-v1"))
        >>> hook.genetic is None
        True
    """

    def __init__(
        self,
        *,
        create_env_fn: Callable[[], EnvBase] | EnvBase,
        max_steps: int | None = None,
        fitness: str = "return",
        target_tau: float = 1.0,
        seed: int = 0,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
        **settings: Any,
    ) -> None:
        if unknown := sorted(settings.keys() & set(NOT_ATTACHED)):
            raise TypeError(f"{unknown} cannot be given to a hook that is attached")
        # Configurations have sequences of a kind of their own.
        settings |= {n: [*settings[n]] for n in SEQUENCES if n in settings}
        self.settings = EvolutionConfig(fitness=fitness, target_tau=target_tau, **settings)
        self.genetic: GeneticHook | None = None
        self._options: dict[str, Any] = {"seed": seed, "on_evaluation": on_evaluation}
        # An environment can be called as well: every module can.
        given = create_env_fn if isinstance(create_env_fn, EnvBase) else None
        self._make_evaluator = functools.partial(
            PopulationEvaluator,
            num_episodes=self.settings.num_trials,
            create_env_fn=create_env_fn if given is None else lambda: given,
            max_steps=max_steps,
            fitness=fitness,
            seed=seed,
            exploration_type=exploration_of(self.settings.act),
        )

    def register(self, trainer: Any, name: str = "genetic_hook") -> None:
        """Find the trainer's policy and register a :class:`GeneticHook` of it.

        Raises:
            ValueError: If the loss has no policy that learns, the trainer collects
                asynchronously or learns in other processes, or an option is out of range.
        """
        check_local(trainer)
        loss = trainer.loss_module
        place = find_policy(loss)
        actor = getattr(loss, place)
        genetic = GeneticHook(
            actor,
            self._make_evaluator(actor),
            breeding_of(self.settings, actor),
            contest_of(self.settings),
            hand_over_of(
                self.settings,
                actor,
                optimizer=trainer.optimizer,
                follow_switch=functools.partial(move_target, loss, place),
            ),
            watch=EpisodeWatch(self.settings.window_episodes),
            period_episodes=self.settings.period_episodes,
            success_range=self.settings.success_range,
            rate_of=self.settings.rate_of,
            **self._options,
        )
        genetic.register(trainer, name)
        self.genetic = genetic

    def state_dict(self) -> dict[str, Any]:
        """State of the hook that was made; the trainer's own state has it as well."""
        return self._registered().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self._registered().load_state_dict(state_dict)

    def _registered(self) -> GeneticHook:
        if self.genetic is None:
            raise RuntimeError("there is no state before register(trainer)")
        return self.genetic


def check_local(trainer: Any) -> None:
    """Raise ValueError if a trainer learns where no hook sees it."""
    backend = getattr(trainer, "learner_backend", "local")
    if backend != "local":
        raise ValueError(
            f"learner_backend={backend!r}: the weights that learn are in other processes, "
            "out of the hook's reach"
        )


def find_policy(loss: Any) -> str:
    """Name of a loss's attribute that is the policy whose own parameters it trains.

    Raises:
        ValueError: If there is none.
    """
    for name in POLICY_NAMES:
        policy = getattr(loss, name, None)
        if policy is None:
            continue
        own = set(policy.parameters()) if isinstance(policy, TensorDictModuleBase) else ()
        if own and own <= set(loss.parameters()):
            return name
        break
    raise ValueError(
        f"no policy in {type(loss).__name__}: looked for {' or '.join(POLICY_NAMES)}, a "
        "tensordict module whose parameters are among those of the loss"
    )
