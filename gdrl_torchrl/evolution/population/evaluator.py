"""``PopulationEvaluator``: the only place where parameters are turned into fitness."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase, Transform
from torchrl.envs.utils import ExplorationType

from gdrl_tasks import Stream, episode_seeds
from gdrl_torchrl import keys
from gdrl_torchrl.evolution.population.actor import PopulationActor
from gdrl_torchrl.evolution.population.env_rollout import PopulationRollout
from gdrl_torchrl.evolution.population.episodes import ordered_episodes
from gdrl_torchrl.evolution.population.rules import EvaluationRules, Fitness, acting
from gdrl_torchrl.evolution.population.simulation_rollout import (
    SimulationRollout,
    simulation_of,
)


class PopulationEvaluator(Transform):
    """Evaluate ``P`` members of an actor's family over the same ``S`` episodes.

    On an environment's step path the transform is the identity; :meth:`evaluate` (or
    calling the transform on a tensordict that holds ``params``) rolls the population
    out. All members and episodes run as one batch of worlds; a population that needs
    more worlds than the environment has runs in chunks. Every evaluation draws fresh
    episodes, the same for every member. A member's score is over the first ``S``
    episodes that it began, however long they last.

    An environment without a batch (a stock dm_control or Gymnasium one) is run
    serially: member by member, episode by episode, its seed set before each reset.

    On a replay buffer of genomes each sample is evaluated; what is stored stays as it
    is, because scores belong to the episodes that they were measured on.

    The scores are those of a plain loop over the members. Policies that cannot act as a
    batch act one by one (``docs/extending/policies.md``).

    Args:
        actor: The actor whose family is evaluated. It is not a submodule and is only
            read: a copy acts, with the actor's modes and buffers at that time.
        num_episodes: Episodes ``S`` per member.
        create_env_fn: Makes the environment to evaluate in; None takes the parent
            environment, which must not be stepped by a collector at the same time.
        max_steps: Steps after which an episode is cut off; its last transition is
            truncated. None waits for its end.
        fitness: ``goals`` (episodes that ended in success), ``return`` (mean return)
            or a function of the result ``[P]`` giving ``[P]``.
        seed: Seed of the fitness episodes.
        episode_seeding: ``reset`` passes ``episode_seed=`` to the environment's reset,
            ``set_seed`` seeds an environment before each reset, ``none`` leaves it
            alone; ``auto`` takes ``reset`` if the environment's worlds have seeds of
            their own and ``set_seed`` otherwise. With ``set_seed`` one member runs at a
            time, because the worlds of a batch would differ between members. If seeds
            are given, one episode runs at a time, because a batch has only one seed.
        exploration_type: How the members act. Unless greedily, they draw from a generator
            of the evaluation's own, seeded by the first of its episodes: the same episodes
            give the same result, and no other draws change.
        success_key: Flag of the environment that marks success, read at the end of an
            episode.
        extra_keys: Further entries of the environment to report ``[P, S]``, as they
            are at the end of an episode.
        trace: Whether the policy may be traced to a graph of tensor operations, which is
            faster. False runs its modules.

    Raises:
        ValueError: If ``num_episodes`` < 1 or ``max_steps`` < 1.

    Examples:
        >>> from gdrl_tasks import make_task
        >>> from gdrl_torchrl.envs.navigation import NavigationEnv
        >>> from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
        >>> from gdrl_torchrl.agents.networks import make_tanh_normal_actor
        >>> env = NavigationEnv(make_task("water", step_limit=5), num_worlds=6)
        >>> actor = make_tanh_normal_actor(3, env.full_action_spec_unbatched["action"])
        >>> evaluator = PopulationEvaluator(
        ...     actor, num_episodes=2, create_env_fn=lambda: env
        ... )
        >>> result = evaluator.evaluate(stack_copies(genome_of(actor), 3))
        >>> result["steps"].tolist()
        [[5, 5], [5, 5], [5, 5]]
    """

    population: PopulationActor

    def __init__(
        self,
        actor: TensorDictModuleBase,
        *,
        num_episodes: int = 10,
        create_env_fn: Callable[[], EnvBase] | None = None,
        max_steps: int | None = None,
        fitness: Fitness = "goals",
        seed: int = 0,
        episode_seeding: Literal["auto", "reset", "set_seed", "none"] = "auto",
        exploration_type: Any = ExplorationType.DETERMINISTIC,
        success_key: NestedKey = keys.SUCCESS,
        extra_keys: tuple[str, ...] = (),
        trace: bool = True,
    ) -> None:
        if num_episodes < 1:
            raise ValueError(f"num_episodes={num_episodes} must be >= 1")
        if max_steps is not None and max_steps < 1:
            raise ValueError(f"max_steps={max_steps} must be >= 1")
        if fitness not in ("goals", "return") and not callable(fitness):
            raise ValueError(f"fitness={fitness!r} must be 'goals', 'return' or callable")
        if episode_seeding not in ("auto", "reset", "set_seed", "none"):
            raise ValueError(
                f"episode_seeding={episode_seeding!r} must be 'auto', 'reset', 'set_seed' "
                "or 'none'"
            )
        # No in_keys: a transform with keys would have to transform them on every step.
        super().__init__()
        # Kept out of the module tree: TransformedEnv would put the policy in eval mode
        # and the environment's state_dict would hold it.
        self.__dict__["population"] = PopulationActor(actor, trace=trace)
        self.num_episodes = num_episodes
        self.max_steps = max_steps
        self.fitness = fitness
        self.seed = seed
        self.num_evaluations = 0
        self.episodes_drawn = 0
        self.episode_seeding = episode_seeding
        self.exploration_type = exploration_type
        self.success_key = success_key
        self.extra_keys = tuple(extra_keys)
        self._create_env_fn = create_env_fn
        self.__dict__["_own_env"] = None

    # On the step path nothing happens.

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate the population under ``params`` and add the scores.

        Args:
            tensordict: ``[P]`` with parameters under ``params``. Without them it
                is returned unchanged, as by a replay buffer that holds transitions.

        Returns:
            The same tensordict with the entries of :meth:`evaluate`.
        """
        params = tensordict.get(keys.PARAMS, None)
        if params is None:
            return tensordict
        return tensordict.update(self.evaluate(params))

    @property
    def env(self) -> EnvBase:
        """The environment that members are evaluated in.

        Raises:
            RuntimeError: If there is none.
        """
        if self._create_env_fn is not None:
            if self.__dict__["_own_env"] is None:
                self.__dict__["_own_env"] = self._create_env_fn()
            return self.__dict__["_own_env"]
        parent = self.parent
        if parent is None:
            raise RuntimeError(
                "PopulationEvaluator needs an environment: pass create_env_fn or append "
                "it to one"
            )
        return parent

    def close(self) -> None:
        """Close the evaluator's own environment."""
        env = self.__dict__["_own_env"]
        if env is not None and not env.is_closed:
            env.close()
        self.__dict__["_own_env"] = None

    @torch.no_grad()
    def evaluate(
        self, params: TensorDictBase, *, seeds: torch.Tensor | None = None
    ) -> TensorDictBase:
        """Score a population.

        Args:
            params: Genomes ``[P]``, as
                :func:`~gdrl_torchrl.evolution.operators.genome.genome_of` names them.
            seeds: Episode seeds ``[S]``, int64; None draws fresh ones.

        Returns:
            A tensordict ``[P]``: ``fitness``, ``success_rate``, ``return_mean`` and
            ``frames`` (environment steps) ``[P]``; ``successes``, ``returns``,
            ``steps``, the extra keys and, if the environment gives them, ``outcomes``
            ``[P, S]``. A member has fitness NaN if one of its actions, of its returns or
            of the outputs that its actions are chosen by is not a number. If all members
            have fitness NaN, the log says why.

        Raises:
            ValueError: If ``params`` do not fit the policy, ``seeds`` are not ``[S]``,
                or the policy or the fitness needs an entry that the environment lacks.
            RuntimeError: If there is no environment, or an episode does not end.
        """
        return self._evaluate(params, seeds, keep_transitions=False)[0]

    @torch.no_grad()
    def evaluate_with_transitions(
        self, params: TensorDictBase, *, seeds: torch.Tensor | None = None
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Do the same as :meth:`evaluate`, and return every transition too.

        Returns:
            The scores ``[P]`` and the transitions ``[N]`` of all episodes, each whole
            and in order, with ``member`` and ``episode`` (int64) beside the
            environment's keys.
        """
        scores, transitions = self._evaluate(params, seeds, keep_transitions=True)
        return scores, transitions

    def fresh_seeds(self, count: int) -> torch.Tensor:
        """Seeds of the next fitness episodes, int64 ``[count]``; no seed comes twice."""
        start = self.episodes_drawn
        self.episodes_drawn += count
        return torch.from_numpy(episode_seeds(Stream.FITNESS, self.seed, start, count))

    def _evaluate(
        self, params: TensorDictBase, seeds: torch.Tensor | None, *, keep_transitions: bool
    ) -> tuple[TensorDictBase, TensorDictBase]:
        env, count = self.env, params.batch_size[0]
        rules = self._rules(env)
        self._check_inputs(env)
        are_given = seeds is not None
        if seeds is None:
            seeds = self.fresh_seeds(self.num_episodes)
        self.num_evaluations += 1
        seeds = torch.as_tensor(seeds, dtype=torch.int64)
        if seeds.ndim != 1 or len(seeds) == 0:
            raise ValueError(f"seeds of shape {tuple(seeds.shape)} must be [S], S >= 1")
        scores = rules.empty_scores(count, len(seeds))
        log: list[TensorDictBase] = []
        worlds = env.batch_size.numel()
        trials = min(len(seeds), worlds)
        members = max(1, worlds // trials)
        if rules.seeding == "set_seed":
            trials, members = 1 if are_given else trials, 1
        try:
            self.population.load(params)
            with acting(self.exploration_type, int(seeds[0])):
                simulation = simulation_of(rules, self.population, env)
                make = PopulationRollout if simulation is None else SimulationRollout
                for first in range(0, count, members):
                    rows = slice(first, min(first + members, count))
                    self.population.choose(rows)
                    for begin in range(0, len(seeds), trials):
                        columns = slice(begin, min(begin + trials, len(seeds)))
                        part = (scores[rows, columns], seeds[columns])
                        rollout = make(rules, self.population, env, *part)
                        rollout.run(log if keep_transitions else None, (first, begin))
        finally:
            self.population.unload()
        return rules.summary(scores), ordered_episodes(log)

    def _check_inputs(self, env: EnvBase) -> None:
        """Raise ValueError if the policy reads an entry that the environment lacks."""
        offered = {*env.full_observation_spec.keys(True), *env.full_done_spec.keys(True)}
        missing = [key for key in self.population.in_keys if key not in offered]
        if missing:
            raise ValueError(
                f"the policy reads {missing}, which the environment does not give: for a "
                "recurrent policy append InitTracker() and the primer that its "
                "make_tensordict_primer() makes"
            )

    def _rules(self, env: EnvBase) -> EvaluationRules:
        return EvaluationRules.of(
            env,
            episode_seeding=self.episode_seeding,
            success_key=self.success_key,
            extra_keys=self.extra_keys,
            max_steps=self.max_steps,
            fitness=self.fitness,
        )
