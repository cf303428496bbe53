"""``AttachedGeneticHook``: a genetic hook whose options come before there is an agent."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl.config.checks import check_choice, check_range
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.hand_over import move_target
from gdrl_torchrl.evolution.operators.mutation import mutations
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

POLICY_NAMES = ("actor_network", "value_network")
"""Where TorchRL's losses keep the policy; beside an actor, the second is a critic."""


class AttachedGeneticHook(TrainerHookBase):
    """Options of a :class:`GeneticHook` that is made when it is registered.

    A configuration cannot name the agent's own policy, for every mention of a network
    in it makes another one: the policy is looked for in the trainer's loss.

    Args:
        create_env_fn: Makes the environment that populations are scored in, or is that
            environment; no collector may step it.
        num_children: Children of an evaluation.
        period_episodes: Training episodes between evaluations.
        num_trials: Episodes that every member is scored on.
        max_steps: Steps after which such an episode is cut off; None waits for its end.
        fitness: ``return``, or ``goals`` where the environment has a flag ``success``.
        mutation: Name of one of :func:`~gdrl_torchrl.evolution.operators.mutation.mutations`.
        std: Standard deviation of the mutation, in weight units.
        rates: Mutation probabilities, from low to high success; the first one where the
            environment has no flag of success.
        thresholds: Success rates at which the next of ``rates`` begins.
        window_episodes: Training episodes that the success rate is over.
        tie_rule: Who wins among equals: ``return_then_parent``, ``parent``, ``child``.
        own_share: Share of its own weights that the agent keeps on a switch.
        target_tau: How far the policy's target network, if the loss has one, moves
            towards the winner on a switch: 1 copies it, 0 leaves the target.
        seed: Seed of the mutations and of the fitness episodes.
        on_evaluation: Called with each :class:`GeneticEvaluation`.

    Attributes:
        genetic: The hook that was made, None before :meth:`register`.

    Raises:
        ValueError: If there is no such mutation, the rates do not fit the thresholds,
            or ``target_tau`` is outside [0, 1].

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
        num_children: int = 10,
        period_episodes: int = 50,
        num_trials: int = 10,
        max_steps: int | None = None,
        fitness: str = "return",
        mutation: str = "bernoulli",
        std: float = 0.1,
        rates: Sequence[float] = (0.75, 0.4, 0.1),
        thresholds: Sequence[float] = (0.4, 0.8),
        window_episodes: int = 100,
        tie_rule: str = "return_then_parent",
        own_share: float = 0.0,
        target_tau: float = 1.0,
        seed: int = 0,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        check_choice("mutation", mutation, mutations())
        check_range("target_tau", target_tau, least=0.0, most=1.0)
        self.genetic: GeneticHook | None = None
        self._target_tau = target_tau
        self._on_evaluation = list(on_evaluation)
        # An environment can be called as well: every module can.
        given = create_env_fn if isinstance(create_env_fn, EnvBase) else None
        self._make_evaluator = functools.partial(
            PopulationEvaluator,
            num_episodes=num_trials,
            create_env_fn=create_env_fn if given is None else lambda: given,
            max_steps=max_steps,
            fitness=fitness,
            seed=seed,
        )
        self._make_hook = functools.partial(
            GeneticHook,
            num_children=num_children,
            period_episodes=period_episodes,
            mutation=mutations()[mutation],
            std=std,
            schedule=MutationSchedule(tuple(rates), tuple(thresholds)),
            tie_rule=tie_rule,
            own_share=own_share,
            window_episodes=window_episodes,
            seed=seed,
        )

    def register(self, trainer: Any, name: str = "genetic_hook") -> None:
        """Find the trainer's policy and register a :class:`GeneticHook` of it.

        Raises:
            ValueError: If the loss has no policy that learns, the trainer collects
                asynchronously or learns in other processes, or an option is out of range.
        """
        if getattr(trainer, "learner_backend", "local") != "local":
            raise ValueError(
                f"learner_backend={trainer.learner_backend!r}: the weights that learn are "
                "in other processes, out of the hook's reach"
            )
        loss = trainer.loss_module
        place = find_policy(loss)
        actor = getattr(loss, place)
        genetic = self._make_hook(
            actor,
            self._make_evaluator(actor),
            on_switch=[lambda: move_target(loss, place, self._target_tau)],
            on_evaluation=self._on_evaluation,
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
