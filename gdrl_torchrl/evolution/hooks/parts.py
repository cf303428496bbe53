"""The parts of a genetic hook, made of its settings."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren
from gdrl_torchrl.evolution.hooks.contest import (
    Contest,
    CopiesContest,
    FullContest,
    PairedContest,
)
from gdrl_torchrl.evolution.hooks.hand_over import HandOver, reset_critic, reset_moments
from gdrl_torchrl.evolution.operators.crossover import crossovers
from gdrl_torchrl.evolution.operators.mutation import mutations, standard_deviation
from gdrl_torchrl.evolution.operators.paired import HalvingPlan
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.operators.sensitivity import output_sensitivity
from gdrl_torchrl.evolution.population.outputs import outputs_of
from gdrl_torchrl.evolution.settings import EvolutionConfig


def breeding_of(settings: EvolutionConfig, actor: TensorDictModuleBase) -> MutatedChildren:
    """What makes the children of an actor."""
    sensitivity = None
    if settings.sensitivity:
        sensitivity = functools.partial(output_sensitivity, outputs_of(actor))
    return MutatedChildren(
        settings.num_children,
        mutation=mutations()[settings.mutation],
        std=standard_deviation(settings.mut_v, settings.mut_v_is),
        schedule=MutationSchedule(tuple(settings.rates), tuple(settings.thresholds)),
        crossover=crossovers()[settings.crossover],
        num_points=settings.num_points,
        sensitivity=sensitivity,
        sensitivity_rows=settings.sensitivity_rows,
    )


def contest_of(settings: EvolutionConfig) -> Contest:
    """Who competes with whom, and who wins."""
    if settings.contest == "full":
        return FullContest(settings.tie_rule)
    if settings.contest == "copies":
        return CopiesContest()
    return PairedContest(
        HalvingPlan(
            screening_trials=settings.screening_trials,
            test_trials=settings.test_trials,
            num_looks=settings.num_looks,
            level=settings.level,
        )
    )


def hand_over_of(
    settings: EvolutionConfig,
    actor: TensorDictModuleBase,
    *,
    optimizer: torch.optim.Optimizer | None = None,
    critic: torch.nn.Module | None = None,
    follow_switch: Callable[[float], object] | None = None,
    share_experience: Callable[[TensorDictBase], object] | None = None,
) -> HandOver:
    """What happens on a switch.

    Args:
        settings: The hook's.
        actor: The agent's policy.
        optimizer: Whose moments ``optimizer_on_switch`` is about.
        critic: What ``critic_on_switch`` is about.
        follow_switch: Moves target networks a share ``target_tau`` of the way.
        share_experience: Takes the transitions ``[T]`` of an evaluation.

    Raises:
        ValueError: If something is to be reset that was not given, or a critic is that
            has no layers of its own.
    """
    on_switch: list[Callable[[], Any]] = []
    if settings.optimizer_on_switch == "reset":
        if optimizer is None:
            raise ValueError("optimizer_on_switch='reset' needs an optimizer")
        on_switch.append(reset_moments(optimizer, actor))
    if settings.critic_on_switch == "reset":
        if critic is None:
            raise ValueError("critic_on_switch='reset' needs a critic")
        on_switch.append(reset_critic(critic, actor))
    if follow_switch is not None:
        on_switch.append(functools.partial(follow_switch, settings.target_tau))
    return HandOver(
        own_share=settings.own_share,
        on_switch=on_switch,
        share_experience=share_experience,
        share_always=settings.share_on == "always",
    )
