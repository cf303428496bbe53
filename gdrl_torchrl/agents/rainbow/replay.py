"""Prioritised replay, shared by an agent and populations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, PrioritizedSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import Storage

STALE = ("td_error", "index", "priority_weight")
"""Entries that a buffer and a loss write into samples; new items must not have them."""


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
        >>> buffer = make_prioritized_buffer(
        ...     100, alpha=0.5, beta=0.4, batch_size=4, seed=0
        ... )
        >>> _ = buffer.extend(TensorDict(observation=torch.rand(9, 3), batch_size=[9]))
        >>> minibatch = draw_minibatch(buffer)
        >>> note_errors(buffer, minibatch.set("td_error", torch.rand(4, 1)))
    """
    sampler: Any = buffer.sampler
    sampler.update_priority(minibatch.get("index"), minibatch.get("td_error").squeeze(-1))


def random_share(
    transitions: TensorDictBase,
    share: float,
    generator: torch.Generator,
    *,
    at_most: int | None = None,
) -> TensorDictBase:
    """Choose a random share of transitions ``[N]``, without replacement.

    Args:
        transitions: Transitions ``[N]``.
        share: Share to keep: ``round(share * N)`` transitions.
        generator: Source of randomness.
        at_most: Most transitions to keep.

    Returns:
        Copies ``[K]``, in their old order.

    Raises:
        ValueError: If the share is outside ``[0, 1]``.

    Examples:
        >>> rows = TensorDict(number=torch.arange(10), batch_size=[10])
        >>> random_share(rows, 0.3, torch.Generator().manual_seed(0)).batch_size
        torch.Size([3])
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share must be in [0, 1]: {share}")
    total = transitions.batch_size[0]
    count = round(share * total) if at_most is None else min(round(share * total), at_most)
    order = torch.randperm(total, generator=generator)
    return transitions[order[:count].sort().values]


def share_experience(
    buffer: TensorDictReplayBuffer,
    transitions: TensorDictBase,
    n_step: Callable[[TensorDictBase], TensorDictBase],
    share: float,
    generator: torch.Generator,
) -> int:
    """Put a random share of other policies' transitions into a buffer.

    Windows over several steps are made from whole episodes before the share is drawn;
    drawing first would join steps that did not follow each other. All transitions that
    enter get the largest priority that any item has had so far. If the share exceeds the
    buffer's capacity, a random part as large as the capacity enters.

    Args:
        buffer: A buffer of :func:`make_prioritized_buffer`.
        transitions: Whole episodes ``[T]`` or ``[W, T]``. Not modified.
        n_step: An :class:`~gdrl_torchrl.agents.rainbow.n_step.NStep`.
        share: Share of the transitions that enters.
        generator: Source of randomness.

    Returns:
        How many transitions entered.

    Raises:
        ValueError: If the share is outside ``[0, 1]``.

    Examples:
        >>> from gdrl_torchrl.agents.rainbow.n_step import NStep
        >>> buffer = make_prioritized_buffer(
        ...     100, alpha=0.5, beta=0.4, batch_size=4, seed=0
        ... )
        >>> ends = torch.tensor([False, True, False, True]).unsqueeze(-1)
        >>> episodes = TensorDict(
        ...     observation=torch.zeros(4, 3),
        ...     action=torch.zeros(4, dtype=torch.long),
        ...     next=TensorDict(
        ...         observation=torch.zeros(4, 3),
        ...         reward=torch.ones(4, 1),
        ...         terminated=ends,
        ...         done=ends,
        ...     ),
        ...     batch_size=[4],
        ... )
        >>> generator = torch.Generator().manual_seed(0)
        >>> share_experience(buffer, episodes, NStep(0.99, 3), 0.5, generator)
        2
    """
    windows = n_step(transitions).exclude(*STALE)
    # With more items than its capacity a buffer would write several to one place.
    sampler: Any = buffer.sampler
    chosen = random_share(windows, share, generator, at_most=sampler.max_size)
    count = chosen.batch_size[0]
    if count:  # extending by nothing is an error
        buffer.extend(chosen)
    return count


def buffer_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """Copy all that a buffer's draws depend on: items, priorities, cursor, randomness.

    The buffer's own ``state_dict`` has the segment trees as C++ objects, which only
    pickle can write, and the unused part of the storage.

    Args:
        buffer: A buffer of :func:`make_prioritized_buffer`.

    Returns:
        Nested dicts of tensors and plain values.

    Examples:
        >>> options = {"alpha": 0.5, "beta": 0.4, "batch_size": 4}
        >>> buffer = make_prioritized_buffer(100, seed=0, **options)
        >>> _ = buffer.extend(TensorDict(observation=torch.rand(9, 3), batch_size=[9]))
        >>> other = make_prioritized_buffer(100, seed=1, **options)
        >>> load_buffer_state(other, buffer_state(buffer))
        >>> bool((buffer.sample() == other.sample()).all())
        True
    """
    sampler: Any = buffer.sampler
    count = len(buffer)
    items = buffer.storage[:count].clone() if count else TensorDict()
    rows = torch.arange(count)
    return {
        "items": items.to_dict(),
        "count": count,
        "priorities": torch.as_tensor(sampler._sum_tree[rows]) if count else None,
        # A value and an index, or None and None.
        "max_priority": [_plain(value) for value in sampler._max_priority],
        "alpha": sampler.alpha,
        "beta": sampler.beta,
        "capacity": sampler.max_size,
        "writer": dict(buffer.writer.state_dict()),
        "generator": _generator(buffer).get_state(),
    }


def load_buffer_state(buffer: TensorDictReplayBuffer, state: Mapping[str, Any]) -> None:
    """Return a buffer to a state of :func:`buffer_state`.

    Args:
        buffer: A buffer with the same capacity and exponent ``alpha``; its items are
            replaced.
        state: The state.

    Raises:
        ValueError: If capacity or ``alpha`` differ.
    """
    sampler: Any = buffer.sampler
    own = {"capacity": sampler.max_size, "alpha": sampler.alpha}
    for name, value in own.items():
        if state[name] != value:
            raise ValueError(f"{name} is {value}, that of the state {state[name]}")
    buffer.empty()
    count = state["count"]
    if count:
        items = TensorDict(state["items"], batch_size=[count])
        # Not through the writer, which would count these items as new ones.
        rows: Any = torch.arange(count)
        buffer.storage.set(rows, items)
        # The leaves determine the trees: every node is recomputed from its children.
        sampler._sum_tree[rows] = state["priorities"]
        sampler._min_tree[rows] = state["priorities"]
    buffer.writer.load_state_dict(dict(state["writer"]))
    sampler._max_priority = tuple(state["max_priority"])
    sampler.beta = state["beta"]
    _generator(buffer).set_state(state["generator"].to(torch.uint8))


def _generator(buffer: TensorDictReplayBuffer) -> torch.Generator:
    generator: Any = buffer._rng
    if generator is None:
        raise ValueError("the buffer has no generator: make it by make_prioritized_buffer")
    return generator


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, torch.Tensor) else value
