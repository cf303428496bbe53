"""Rainbow's loss (arXiv 1710.02298): distributional, double, n-step, weighted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import DistributionalQValueActor, NoisyLinear
from torchrl.objectives import DistributionalDQNLoss

ACTION_SPACES = ("categorical", "one_hot")
TOLERANCE = 1e-3
"""Distance to the support, in atoms, that counts as rounding and not as clipping."""


class RainbowLoss(DistributionalDQNLoss):
    """Cross-entropy to the projected n-step target (arXiv 1707.06887, algorithm 1).

    The online network, with its noise, selects the next action and the target network,
    with noise of its own, values it. The loss of a batch is ``mean(w * l)`` with
    prioritised replay's weights ``w``, as in arXiv 1511.05952, and not TorchRL's
    ``sum(w * l) / sum(w)``. Everything stays on the device of the batch.

    It reads ``observation``, ``action``, ``priority_weight`` (1 if missing),
    ``steps_to_next_obs`` (1 if missing), each ``[B]`` or ``[B, 1]``, and of ``next``
    the ``observation``, ``reward`` (the discounted sum over these steps) and
    ``terminated``. It writes ``td_error`` ``[B, 1]``: the KL divergence, which
    Rainbow takes as priority. The cross-entropy is larger by the entropy of the target,
    which no learning removes: with it the most uncertain transitions would be replayed
    for ever.

    The loss calls neither :func:`soft_update_target` nor :func:`resample_noise`.

    Args:
        value_network: An actor of
            :func:`~gdrl_torchrl.agents.rainbow.network.make_q_actor` or one like it, with
            an evenly spaced support.
        gamma: Discount per step.

    Raises:
        ValueError: If the actor is another one.

    Examples:
        >>> from gdrl_torchrl.agents.rainbow.network import make_q_actor
        >>> loss = RainbowLoss(make_q_actor(3, 5, value_range=(-1.0, 1.0)), gamma=0.99)
        >>> batch = TensorDict(
        ...     observation=torch.zeros(7, 3),
        ...     action=torch.zeros(7, dtype=torch.long),
        ...     next=TensorDict(
        ...         observation=torch.zeros(7, 3),
        ...         reward=torch.zeros(7, 1),
        ...         terminated=torch.zeros(7, 1, dtype=torch.bool),
        ...     ),
        ...     batch_size=[7],
        ... )
        >>> sorted(loss(batch).keys()), batch["td_error"].shape
        (['clipped_mass', 'loss', 'q_mean'], torch.Size([7, 1]))
    """

    # TorchRL's losses run without exploration. Noisy layers would then use their means
    # only, and the scales of the noise would never get a gradient.
    deterministic_sampling_mode: Any = ExplorationType.RANDOM

    def __init__(self, value_network: DistributionalQValueActor, *, gamma: float) -> None:
        if not isinstance(value_network, DistributionalQValueActor):
            raise ValueError(
                "value_network must be a DistributionalQValueActor: "
                f"{type(value_network).__name__}"
            )
        if value_network.action_space not in ACTION_SPACES:
            raise ValueError(
                f"action_space must be one of {ACTION_SPACES}: {value_network.action_space}"
            )
        gaps = value_network.support.diff()
        if not (gaps > 0).all() or not torch.allclose(gaps, gaps.mean(), rtol=1e-3):
            raise ValueError(
                f"support must be evenly spaced and increasing: {value_network.support}"
            )
        super().__init__(value_network, gamma=gamma, delay_value=True)
        # At every call TorchRL looks for one of its target updaters, and warns without one.
        self._has_update_associated["value_network"] = True

    @property
    def in_keys(self) -> list[Any]:
        """Keys that the loss reads; without them ``repr`` of TorchRL's own loss fails."""
        names, observed = self.tensor_keys, list(self._network.in_keys)
        flags = [("next", key) for key in (*observed, names.reward, names.terminated)]
        return [*observed, names.action, *flags]

    @property
    def out_keys(self) -> list[Any]:
        """Keys that the loss returns."""
        return ["loss", "q_mean", "clipped_mass"]

    def forward(self, input_tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of transitions ``[B]``.

        Returns:
            ``loss``, and detached ``q_mean`` (the mean value of the actions taken) and
            ``clipped_mass``: the share of the targets' probability outside the
            support. It is 0 if ``v_min <= reward + gamma * v <= v_max`` for all rewards
            and all values ``v`` of the support.

        Raises:
            ValueError: If the batch has not one dimension.
        """
        batch: Any = input_tensordict
        if batch.batch_dims != 1:
            raise ValueError(f"the batch must have one dimension: {batch.batch_size}")
        size, names = batch.batch_size[0], self.tensor_keys
        following = batch["next"]
        support = self.value_network_params["support"]

        with self._online():
            logits = self._logits(batch)
            with torch.no_grad():
                ahead = self._logits(following)
        with torch.no_grad():
            # The action with the best mean; this needs no logarithms and no gradient.
            best = (ahead.softmax(-1) @ support).argmax(-1)
            with self._target():
                values = _of_actions(self._logits(following), best).softmax(-1)
            steps = batch.get(names.steps_to_next_obs, support.new_ones(size))
            # Shapes are forced: [B] with [B, 1] would broadcast to [B, B], which would be
            # taken for [B, Z] if there are as many transitions as atoms.
            goes_on = ~following[names.terminated].reshape(size, 1)
            target, clipped = project(
                values,
                following[names.reward].reshape(size, 1),
                self.gamma ** steps.reshape(size, 1) * goes_on,
                support,
            )

        action = batch[names.action]
        if self.action_space == "one_hot":
            action = action.long().argmax(-1)
        log_values = _of_actions(logits, action.reshape(size)).log_softmax(-1)
        cross_entropy = -(target * log_values).sum(-1)
        with torch.no_grad():
            # Rounding must not make it negative, because prioritised replay takes powers.
            divergence = cross_entropy + torch.xlogy(target, target).sum(-1)
            batch.set(names.priority, divergence.clamp_min(0.0).unsqueeze(-1))
            q_mean = (log_values.exp() * support).sum(-1).mean()
        weight = batch.get(names.priority_weight, None)
        if weight is not None:
            cross_entropy = cross_entropy * weight.reshape(size)
        return TensorDict(
            loss=cross_entropy.mean(), q_mean=q_mean, clipped_mass=clipped.mean()
        )

    @property
    def _network(self) -> Any:
        # Only the first part of the actor has parameters. Its heads normalise and
        # choose for all actions; normalising twice would change nothing.
        actor: Any = self.value_network
        return actor.module[0]

    def _online(self) -> Any:
        return self._installed(self.value_network_params)

    def _target(self) -> Any:
        return self._installed(self.target_value_network_params)

    @contextmanager
    def _installed(self, params: Any) -> Iterator[None]:
        own, error = params.get(("module", "0")), None
        with own.to_module(self._network, preserve_module_state=False):
            # Without this tensordict would leave these weights in after an exception.
            try:
                yield
            except Exception as raised:
                error = raised
        if error is not None:
            raise error

    def _logits(self, rows: TensorDictBase) -> torch.Tensor:
        inputs = rows.select(*self._network.in_keys)
        values = self._network(inputs).get(self.tensor_keys.action_value)
        # Atoms last, as our network has them in memory.
        return values.transpose(-1, -2)


def project(
    values: torch.Tensor,
    reward: torch.Tensor,
    discount: torch.Tensor,
    support: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distribution of ``reward + discount * value``, projected onto the support.

    Args:
        values: Probabilities ``[B, Z]`` of the next values, on the support.
        reward: ``[B, 1]``.
        discount: ``[B, 1]``, 0 where the episode terminated.
        support: Values ``[Z]``, evenly spaced.

    Returns:
        Probabilities ``[B, Z]``, and the probability ``[B]`` that lay outside the
        support and was moved to its ends.

    Examples:
        >>> half = torch.tensor([[0.5, 0.5, 0.0]])
        >>> one = torch.ones(1, 1)
        >>> project(half, 0.25 * one, one, torch.tensor([-1.0, 0.0, 1.0]))
        (tensor([[0.3750, 0.5000, 0.1250]]), tensor([0.]))
    """
    last = support.shape[0] - 1
    gap = (support[-1] - support[0]) / last
    position = (reward + discount * support - support[0]) / gap
    outside = (position < -TOLERANCE) | (position > last + TOLERANCE)
    position = position.clamp(0.0, last)
    # The atom below, but never the last atom. A position on an atom is then no special
    # case: all of its probability goes to one of the two neighbours.
    below = position.long().clamp_max(last - 1)
    upper = values * (position - below)
    # Nothing is written in place, because that would keep the loss from being traced.
    projected = torch.zeros_like(values).scatter_add(-1, below, values - upper)
    projected = projected.scatter_add(-1, below + 1, upper)
    return projected, (values * outside).sum(-1)


@torch.no_grad()
def soft_update_target(loss: RainbowLoss, tau: float) -> None:
    """Move the target network a share ``tau`` of the way to the online one, in place.

    TorchRL's ``SoftUpdate`` copies the online network when it is made; this function
    never does. The noise of the target network does not change.

    Args:
        loss: The loss that has both networks.
        tau: 0 leaves the target unchanged, 1 copies the online network.

    Raises:
        ValueError: If ``tau`` is outside ``[0, 1]``.

    Examples:
        >>> from gdrl_torchrl.agents.rainbow.network import make_q_actor
        >>> loss = RainbowLoss(make_q_actor(3, 5, value_range=(-1.0, 1.0)), gamma=0.99)
        >>> soft_update_target(loss, 0.005)
    """
    if not 0.0 <= tau <= 1.0:
        raise ValueError(f"tau must be in [0, 1]: {tau}")
    torch._foreach_lerp_(*target_and_online(loss), tau)


def target_and_online(loss: RainbowLoss) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Parameters of the target network and of the online one, in the same order.

    They share memory with the parameters of the loss.
    """
    online, target = loss.value_network_params, loss.target_value_network_params
    pairs = [
        (target.get(key).data, parameter.data)
        for key, parameter in online.items(include_nested=True, leaves_only=True)
        if isinstance(parameter, nn.Parameter)
    ]
    targets, parameters = map(list, zip(*pairs, strict=True))
    return targets, parameters


@torch.no_grad()
def resample_noise(loss: RainbowLoss) -> None:
    """Draw new noise for the online and for the target network, one after the other.

    ``loss.apply(reset_noise)`` does nothing, as losses hide their networks from
    ``apply``, and no updater of TorchRL touches the target's noise. The actor that the
    loss was made with shares the online noise. Networks without noise do not change.

    Args:
        loss: The loss that has both networks.

    Examples:
        >>> from gdrl_torchrl.agents.rainbow.network import make_q_actor
        >>> actor = make_q_actor(3, 5, value_range=(-1.0, 1.0), noisy=True)
        >>> resample_noise(RainbowLoss(actor, gamma=0.99))
    """
    layers = [m for m in loss._network.modules() if isinstance(m, NoisyLinear)]
    if not layers:
        return
    for installed in (loss._online, loss._target):
        with installed():
            for layer in layers:
                layer.reset_noise()


def _of_actions(logits: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Logits ``[B, Z]`` of actions ``[B]``, from those of all actions ``[B, A, Z]``."""
    count = logits.shape[1]
    rows = torch.arange(0, count * len(action), count, device=action.device)
    # With one index: two take twice the time in the forward and the backward pass.
    return logits.flatten(0, 1).index_select(0, rows + action)
