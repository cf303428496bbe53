"""From a configuration to the objects that train."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.config.schema import EvolutionConfig, ExperimentConfig
from gdrl_torchrl.config.task import make_task_from_config
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.evolution.mutation import MUTATIONS, standard_deviation
from gdrl_torchrl.evolution.schedule import MutationSchedule
from gdrl_torchrl.training.agent import Agent, check_actions
from gdrl_torchrl.training.genetic import GeneticHook
from gdrl_torchrl.training.ppo import make_ppo_actor, make_ppo_agent
from gdrl_torchrl.training.rainbow import make_rainbow_actor, make_rainbow_agent
from gdrl_torchrl.transforms.population_evaluator import PopulationEvaluator

_MakeActor = Callable[[NavigationTask, ExperimentConfig], TensorDictModuleBase]
_MakeAgent = Callable[[ExperimentConfig, NavigationTask, EnvBase], Agent]

ACTORS: dict[str, _MakeActor] = {"ppo": make_ppo_actor, "rainbow": make_rainbow_actor}
AGENTS: dict[str, _MakeAgent] = {"ppo": make_ppo_agent, "rainbow": make_rainbow_agent}


@dataclasses.dataclass
class Training:
    """The objects of one run."""

    task: NavigationTask
    env: EnvBase
    agent: Agent
    genetic: GeneticHook
    """Watches success; evaluates populations unless evolution is disabled."""

    def close(self) -> None:
        """Close the environments."""
        self.genetic.evaluator.close()
        if not self.env.is_closed:
            self.env.close()


def build_training(config: ExperimentConfig) -> Training:
    """Build everything that a run trains with; seeds are the configuration's.

    The global torch generator must have been seeded by the caller: initial weights and
    the policy's noise come from it.

    Raises:
        ValueError: If task and algorithm do not fit, or an option is out of range.
    """
    task = make_task_of(config)
    env = make_env(
        task,
        config.algorithm.num_worlds,
        backend=config.task.backend,
        num_threads=config.simulation.num_threads,
        seed=config.seed,
    )
    agent = AGENTS[config.algorithm.name](config, task, env)
    genetic = make_genetic_hook(config, task, agent)
    genetic.register(agent.trainer)
    return Training(task, env, agent, genetic)


def make_task_of(config: ExperimentConfig) -> NavigationTask:
    """The task of a run.

    Raises:
        ValueError: If task and algorithm do not fit, or an option is out of range.
    """
    task = make_task_from_config(config.task)
    # Not by making an actor: its weights would come from the run's generator.
    check_actions(task, config)
    return task


def make_actor(task: NavigationTask, config: ExperimentConfig) -> TensorDictModuleBase:
    """The policy of a run, with new weights.

    Raises:
        ValueError: If task and algorithm do not fit.
    """
    return ACTORS[config.algorithm.name](task, config)


def make_genetic_hook(
    config: ExperimentConfig, task: NavigationTask, agent: Agent
) -> GeneticHook:
    """The genetic hook and its evaluator, which has an environment of its own."""
    evolution = config.evolution
    worlds = evolution.num_worlds or (1 + evolution.num_children) * evolution.num_trials
    evaluator = PopulationEvaluator(
        agent.actor,
        num_episodes=evolution.num_trials,
        create_env_fn=lambda: make_env(
            task,
            worlds,
            backend=config.task.backend,
            num_threads=config.simulation.num_threads,
            seed=config.seed,
        ),
        fitness=evolution.fitness,
        seed=config.seed,
    )
    on_switch: list[Callable[[], object]] = []
    if agent.follow_switch is not None:
        on_switch.append(functools.partial(agent.follow_switch, evolution.target_tau))
    return GeneticHook(
        agent.actor,
        evaluator,
        num_children=evolution.num_children,
        period_episodes=evolution.period_episodes if evolution.enabled else None,
        mutation=MUTATIONS[evolution.mutation],
        std=standard_deviation(evolution.mut_v, evolution.mut_v_is),
        schedule=_schedule(evolution),
        window_episodes=evolution.window_episodes,
        tie_rule=evolution.tie_rule,
        optimizer_on_switch=evolution.optimizer_on_switch,
        critic_on_switch=evolution.critic_on_switch,
        optimizer=agent.optimizer,
        critic=agent.critic,
        on_switch=on_switch,
        share_experience=_sharing(agent, evolution.experience_share),
        seed=config.seed,
    )


def _schedule(evolution: EvolutionConfig) -> MutationSchedule:
    return MutationSchedule(tuple(evolution.rates), tuple(evolution.thresholds))


def _sharing(agent: Agent, share: float) -> Callable[[TensorDictBase], object] | None:
    take = agent.share_experience
    if take is None or share == 0.0:
        return None
    return lambda transitions: take(transitions, share)
