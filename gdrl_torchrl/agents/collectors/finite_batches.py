"""What a task gives is held to be finite before anything is learnt from it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase

from gdrl_torchrl import keys

_CHECKED: tuple[Any, ...] = (
    keys.OBSERVATION,
    ("next", keys.OBSERVATION),
    ("next", keys.REWARD),
)


class NonFiniteBatchError(RuntimeError):
    """An observation or a reward that was collected is not a finite number.

    Attributes:
        names: The entries of the batch that are not finite.
        batch: The steps ``[T]`` of a world with such a number.
    """

    advice = (
        "gdrl-replay tells more of it; once the task is mended, the same command goes on"
    )

    def __init__(self, message: str, names: list[str], batch: TensorDictBase) -> None:
        super().__init__(message)
        self.names = names
        self.batch = batch


def check_batch(batch: TensorDictBase) -> TensorDictBase:
    """A batch ``[W, T]``, whose observations and rewards must be finite.

    Entries that it does not have are not looked for. It is a ``batch_process`` of
    trainers, before whatever is to learn from batches.

    Raises:
        NonFiniteBatchError: If a number is not.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> reward = torch.tensor([[[0.0], [0.0]], [[0.0], [torch.inf]]])
        >>> check_batch(TensorDict(next={"reward": reward}, batch_size=[2, 2]))
        Traceback (most recent call last):
        gdrl_torchrl.agents.collectors.finite_batches.NonFiniteBatchError: \
        next.reward=inf of world 1, in its step 1 of a batch, must be finite: the task \
        gave it
    """
    found = {key: batch.get(key, None) for key in _CHECKED}
    broken = {
        key: ~values.isfinite()
        for key, values in found.items()
        if values is not None and not bool(values.isfinite().all())
    }
    if not broken:
        return batch
    key, where = next(iter(broken.items()))
    world, step, *rest = where.nonzero()[0].tolist()
    value = float(found[key][(world, step, *rest)])
    seed = batch.get(keys.EPISODE_SEED, None)
    episode = "" if seed is None else f" (episode_seed={int(seed[world, step])})"
    raise NonFiniteBatchError(
        f"{_dotted(key)}={value} of world {world}, in its step {step} of a batch{episode}, "
        "must be finite: the task gave it",
        [_dotted(name) for name in broken],
        batch[world],
    )


def _dotted(key: Any) -> str:
    return key if isinstance(key, str) else ".".join(key)
