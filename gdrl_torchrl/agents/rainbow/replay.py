"""Prioritised replay: its buffer, its minibatches and their priorities."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, PrioritizedSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import Storage


class BatchWeightSampler(PrioritizedSampler):
    """Prioritised sampling with weights relative to the largest of their batch.

    The weights are ``(min(p) / p_i)^beta`` (arXiv 1511.05952, section 3.4, with the
    maximum over the batch, as in Dopamine's Rainbow). TorchRL takes the smallest
    probability of the whole buffer: one transition that is learnt perfectly then makes
    every weight, and with it every step of the optimiser, small.
    """

    def sample(self, storage: Storage, batch_size: int) -> Any:
        """Draw indices and their weights ``[B]``, of which the largest is 1."""
        drawn: Any = super().sample(storage, batch_size)
        index, info = drawn
        weight = info["priority_weight"]
        return index, {**info, "priority_weight": weight / weight.max()}


def make_prioritized_buffer(
    capacity: int,
    *,
    alpha: float,
    beta: float,
    batch_size: int,
    seed: int,
    eps: float = 1e-6,
    weights_relative_to_batch: bool = True,
) -> TensorDictReplayBuffer:
    """Make a prioritised replay buffer (proportional variant of arXiv 1511.05952).

    Its draws depend on ``seed`` alone, not on the global state of NumPy or torch. New
    items get the largest priority that ever was. ``buffer.sampler.beta`` may be changed
    at any time.

    Args:
        capacity: Most transitions that it holds; the oldest are overwritten.
        alpha: Exponent of the priorities, 0 for uniform draws.
        beta: Exponent of the importance weights, 1 for full correction.
        batch_size: Transitions per sample.
        seed: Seed of its draws.
        eps: Added to every priority, so that none is 0.
        weights_relative_to_batch: Whether weights are divided by the largest of the
            batch; by the largest of the whole buffer otherwise.

    Returns:
        A buffer for flat transitions ``[N]``; a sample ``[B]`` has ``index`` and
        ``priority_weight`` ``[B]``, and ``update_tensordict_priority`` reads
        ``td_error`` from it.

    Raises:
        ValueError: If a value is out of range.
        OSError: If there is no shared memory, in which TorchRL keeps a buffer's counters.

    Examples:
        >>> from tensordict import TensorDict
        >>> buffer = make_prioritized_buffer(
        ...     100, alpha=0.5, beta=0.4, batch_size=4, seed=0
        ... )
        >>> _ = buffer.extend(TensorDict(observation=torch.zeros(9, 3), batch_size=[9]))
        >>> buffer.sample()["priority_weight"]
        tensor([1., 1., 1., 1.])
    """
    for name, value in (("capacity", capacity), ("batch_size", batch_size)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1: {value}")
    if eps <= 0.0:
        raise ValueError(f"eps must be positive: {eps}")
    kind = BatchWeightSampler if weights_relative_to_batch else PrioritizedSampler
    try:
        return TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity),
            # The wheels of TorchRL have segment trees for the CPU only.
            sampler=kind(capacity, alpha=alpha, beta=beta, eps=eps, device="cpu"),
            batch_size=batch_size,
            priority_key="td_error",
            # Without one the sampler draws from NumPy's global state.
            generator=torch.Generator().manual_seed(seed),
        )
    except OSError as error:
        # No error number: it is none of the disk that runs are on.
        raise OSError(
            f"a replay buffer needs shared memory, and /dev/shm cannot be used ({error}): "
            "mount it, in a container with --shm-size=64m or more"
        ) from error


def draw_minibatch(buffer: TensorDictReplayBuffer) -> TensorDictBase:
    """A minibatch of a buffer, as its ``sample()`` gives it.

    ``sample()`` also looks for transforms, prefetching, locks and old options; without
    that, drawing takes half the time.

    Args:
        buffer: A buffer of :func:`make_prioritized_buffer`.

    Returns:
        Transitions ``[B]`` with ``index`` and ``priority_weight`` ``[B]``.

    Raises:
        RuntimeError: If the buffer is empty.

    Examples:
        >>> from tensordict import TensorDict
        >>> buffer = make_prioritized_buffer(
        ...     100, alpha=0.5, beta=0.4, batch_size=4, seed=0
        ... )
        >>> _ = buffer.extend(TensorDict(observation=torch.rand(9, 3), batch_size=[9]))
        >>> draw_minibatch(buffer)["observation"].shape
        torch.Size([4, 3])
    """
    size: Any = buffer.batch_size
    drawn: Any = buffer.sampler.sample(buffer.storage, size)
    index, info = drawn
    storage: Any = buffer.storage
    # Indexing the storage itself would first make a view of its filled part.
    rows = storage._storage.apply(lambda x: x.index_select(0, index), batch_size=[size])
    return rows.set("index", index).set("priority_weight", info["priority_weight"])


def note_errors(buffer: TensorDictReplayBuffer, minibatch: TensorDictBase) -> None:
    """Make ``td_error`` ``[B, 1]`` of a minibatch the priority of its transitions.

    The same as ``buffer.update_tensordict_priority``, for a minibatch of the buffer.

    Examples:
        >>> from tensordict import TensorDict
        >>> buffer = make_prioritized_buffer(
        ...     100, alpha=0.5, beta=0.4, batch_size=4, seed=0
        ... )
        >>> _ = buffer.extend(TensorDict(observation=torch.rand(9, 3), batch_size=[9]))
        >>> minibatch = draw_minibatch(buffer)
        >>> note_errors(buffer, minibatch.set("td_error", torch.rand(4, 1)))
    """
    sampler: Any = buffer.sampler
    sampler.update_priority(minibatch.get("index"), minibatch.get("td_error").squeeze(-1))
