"""PPO's loss and advantage, composed from TorchRL modules."""

from __future__ import annotations

from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from gdrl_torchrl.agents.ppo.advantage import CompiledGAE
from gdrl_torchrl.agents.ppo.settings import PPOConfig


def make_ppo_loss(
    actor: ProbabilisticActor, critic: ValueOperator, config: PPOConfig
) -> tuple[ClipPPOLoss, GAE]:
    """Compose the clipped loss (arXiv 1707.06347, eq. 7) and its advantage estimator.

    Args:
        actor: Policy that writes ``action_log_prob``.
        critic: Value network that writes ``state_value``.
        config: Coefficients.

    Returns:
        The loss, and the estimator (generalised advantage, arXiv 1506.02438) that
        writes what the loss reads into batches ``[W, T]``.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from gdrl_torchrl.agents.networks import (
        ...     make_tanh_normal_actor,
        ...     make_value_network,
        ... )
        >>> actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))
        >>> loss, advantage = make_ppo_loss(actor, make_value_network(3), PPOConfig())
        >>> loss.critic_coeff
        tensor(0.5000)
    """
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip_epsilon,
        entropy_bonus=config.entropy_coeff > 0.0,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=config.normalize_advantage,
    )
    advantage = CompiledGAE(gamma=config.gamma, lmbda=config.lmbda, value_network=critic)
    return loss, advantage
