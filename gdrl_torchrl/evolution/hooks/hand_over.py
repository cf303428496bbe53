"""What happens to the agent when a member takes its place."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.trainers.trainers import UpdateWeights

from gdrl_torchrl.evolution.operators.crossover import mean_crossover
from gdrl_torchrl.evolution.operators.genome import install
from gdrl_torchrl.evolution.settings import EvolutionConfig


class HandOver:
    """Writes a winner's weights into the agent, and tells who must follow.

    The agent keeps its Parameter objects, so that the loss, the optimiser and the
    collector see the new weights.

    Args:
        own_share: Share of its own weights that the agent keeps: 0 replaces it, as in
            AAMAS 2020; 0.3 is the soft update of Supe-RL (ICLR 2021).
        on_switch: Called one after the other, while the actor has the winner's own
            weights: see :func:`reset_moments`, :func:`reset_critic`, :func:`move_target`.
        share_experience: Called with the transitions ``[T]`` of an evaluation (whole
            episodes, one after another); without it they are not kept.
        share_always: Whether experience is shared after every evaluation, and not on a
            switch only.

    Raises:
        ValueError: If ``own_share`` is outside [0, 1).
    """

    def __init__(
        self,
        *,
        own_share: float = 0.0,
        on_switch: Sequence[Callable[[], object]] = (),
        share_experience: Callable[[TensorDictBase], object] | None = None,
        share_always: bool = False,
    ) -> None:
        if not 0.0 <= own_share < 1.0:
            raise ValueError(f"own_share={own_share} must be in [0, 1)")
        self.own_share = own_share
        self.on_switch = list(on_switch)
        self.share_experience = share_experience
        self.share_always = share_always

    def install(
        self,
        actor: nn.Module,
        own: TensorDictBase,
        winner: TensorDictBase,
        trainer: Any = None,
    ) -> None:
        """Make the winner the agent.

        Args:
            actor: The agent's policy.
            own: Its genome.
            winner: The winner's genome.
            trainer: Its trainer, whose collector gets the weights.
        """
        install(actor, winner)
        for follow in self.on_switch:
            follow()
        if self.own_share > 0.0:
            install(actor, mean_crossover(own, winner, share=self.own_share))
        if trainer is not None:
            update_collector(trainer)

    def share(self, transitions: TensorDictBase | None, *, switched: bool) -> None:
        """Share the experience of an evaluation, if it is to be shared."""
        if self.share_experience is not None and (switched or self.share_always):
            assert transitions is not None
            self.share_experience(transitions)


def reset_moments(
    optimizer: torch.optim.Optimizer, actor: nn.Module
) -> Callable[[], object]:
    """What forgets an optimiser's moments of the actor's parameters."""

    def reset() -> None:
        for parameter in actor.parameters():
            optimizer.state.pop(parameter, None)

    return reset


def reset_critic(critic: nn.Module, actor: nn.Module) -> Callable[[], object]:
    """What gives new weights to the layers of a critic that are not the actor's too.

    Layers that both share are the winner's.

    Raises:
        ValueError: If there are none to reset.
    """
    shared = set(actor.parameters())
    layers: list[Any] = [
        module
        for module in critic.modules()
        if callable(getattr(module, "reset_parameters", None))
        and shared.isdisjoint(module.parameters())
    ]
    if not layers:
        raise ValueError(
            f"critic_on_switch='reset': {type(critic).__name__} has no layers to reset "
            "that are not the actor's too"
        )

    def reset() -> None:
        for layer in layers:
            layer.reset_parameters()

    return reset


@torch.no_grad()
def move_target(loss: Any, name: str, tau: float) -> None:
    """Move a network's target a share ``tau`` of the way to it, if it has a target."""
    target = f"target_{name}_params"
    # Without a target network this attribute is a view of the network's own weights.
    if target not in dict(loss.named_children()):
        return
    targets = getattr(loss, target)
    for key, source in getattr(loss, f"{name}_params").items(True, True):
        if isinstance(source, nn.Parameter):
            targets.get(key).lerp_(source, tau)


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


def hand_over_of(
    settings: EvolutionConfig,
    actor: TensorDictModuleBase,
    *,
    optimizer: torch.optim.Optimizer | None = None,
    critic: torch.nn.Module | None = None,
    follow_switch: Callable[[float], object] | None = None,
    share_experience: Callable[[TensorDictBase], object] | None = None,
) -> HandOver:
    """What happens on a switch, as settings ask for it.

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
