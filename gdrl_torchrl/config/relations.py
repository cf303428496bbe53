"""What must hold between the parts of a configuration, before anything is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gdrl_torchrl.agents.settings import check_actions
from gdrl_torchrl.checks import num_weights
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import make_task_from_config

if TYPE_CHECKING:
    from gdrl_tasks import NavigationTask

_MOST_DM_CONTROL_SEED = (2**32 - 1) // 1000 - 100
"""A world's seed is a thousand times the run's and its number, and has 32 bits."""


_MOST_WEIGHTS_OF_ALL = 2**28
"""Of all members of a population together: a gibibyte."""


def make_task_of(config: ExperimentConfig) -> NavigationTask:
    """The task of a run.

    Raises:
        ValueError: If task and algorithm do not fit, or an option is out of range.
    """
    for name in ("task", "algorithm"):
        if getattr(config, name) is None:
            raise ValueError(f"{name}=None must be given")
    task = make_task_from_config(config.task)
    # Not by making an actor: its weights would come from the run's generator.
    check_fit(task, config)
    check_relations(config, task)
    return task


def check_relations(config: ExperimentConfig, task: NavigationTask) -> None:
    """Raise ValueError if parts of a configuration exclude each other.

    Only what concerns training: a trained policy may be evaluated on another task.
    """
    algorithm, budget, evolution = config.algorithm, config.budget, config.evolution
    label = f"algorithm.name={algorithm.name!r}"
    # Algorithms of other packages need not have such a field.
    num_steps, limit = getattr(algorithm, "num_steps", 1), task.spec.step_limit
    if num_steps > limit:
        raise ValueError(
            f"algorithm.num_steps={num_steps} must be <= task.step_limit={limit}: no "
            "return is over more steps than an episode has"
        )
    is_bare_population = not getattr(algorithm, "collects", True)
    if is_bare_population and budget.total_steps is budget.wall_s is None:
        raise ValueError(
            f"budget.agent_steps={budget.agent_steps} must not be the only budget with "
            f"{label}, whose agent takes no steps: give budget.total_steps"
        )
    _check_population(config)
    on_switch = getattr(evolution, "critic_on_switch", "keep")
    if on_switch == "reset" and not getattr(algorithm, "has_critic", True):
        raise ValueError(
            f"evolution.critic_on_switch='reset' must be 'keep' with {label}, which has no "
            "critic"
        )
    replays = getattr(algorithm, "replay_capacity", None) is not None
    if getattr(evolution, "updates_for_shared", False) and not replays:
        raise ValueError(
            f"evolution.updates_for_shared=True must be False with {label}, which replays "
            "no experience"
        )
    if config.evaluation.num_policies and config.budget.total_steps is None:
        raise ValueError(
            f"evaluation.num_policies={config.evaluation.num_policies} needs "
            "budget.total_steps, at equal steps of which they are kept"
        )
    if config.task.backend == "dm_control" and config.seed > _MOST_DM_CONTROL_SEED:
        raise ValueError(
            f"seed={config.seed} must be <= {_MOST_DM_CONTROL_SEED} with "
            "task.backend='dm_control'"
        )


def check_fit(task: NavigationTask, config: ExperimentConfig) -> None:
    """Raise ValueError unless task, algorithm and evolution go together."""
    name = config.algorithm.name
    if not getattr(config.algorithm, "collects", True) and config.evolution.enabled:
        raise ValueError(
            f"evolution.enabled=True must be False (evolution=none) with algorithm.name="
            f"{name!r}, which is a population already"
        )
    check_actions(task, config.algorithm)
    evolution = config.evolution
    if not task.spec.is_discrete or not evolution.enabled:
        return
    if getattr(evolution, "num_distilled", 0):
        raise ValueError(
            f"evolution.num_distilled={evolution.num_distilled} must be 0 with discrete "
            "actions, which no policy can be fitted to by their errors"
        )


def _check_population(config: ExperimentConfig) -> None:
    """Raise ValueError if all members together have too many weights for a memory."""
    weights = num_weights(config.network.actor_cells)
    for group in ("algorithm", "evolution"):
        options = getattr(config, group)
        for field in ("num_children", "population_size"):
            members = getattr(options, field, 0)
            if members * weights > _MOST_WEIGHTS_OF_ALL:
                raise ValueError(
                    f"{group}.{field}={members} must be <= "
                    f"{_MOST_WEIGHTS_OF_ALL // weights} with network.actor_cells="
                    f"{config.network.actor_cells}, so that all members fit into memory"
                )
