"""How much a policy's outputs depend on each weight, and mutations divided by it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase

Outputs = Callable[[TensorDictBase, torch.Tensor], torch.Tensor]
"""``(genome, observation [D]) -> outputs [K]``, differentiable."""

_ROWS_AT_A_TIME = 32
"""Gradients of every row, output and weight are in memory at once."""


def output_sensitivity(
    outputs: Outputs, genome: TensorDictBase, observations: torch.Tensor
) -> TensorDictBase:
    """Mean absolute gradient of a policy's outputs with respect to each weight.

    ``s_w = sqrt(sum_k (mean_i |d y_ik / d w|)^2)`` over observations i and outputs k: the
    sensitivity of SM-G-ABS, a safe mutation through gradients (Lehman et al. 2018,
    https://arxiv.org/abs/1712.06563), as in the authors' code
    (https://github.com/uber-research/safemutations). Their SM-G-SUM, which PDERL's
    proximal mutation takes (https://arxiv.org/abs/1906.09807), has
    ``|sum_i d y_ik / d w|`` instead: it is cheaper, but gradients of opposite sign cancel.

    Args:
        outputs: ``(genome, observation [D]) -> [K]``, differentiable.
        genome: Weights by nested name, batch size ``[]``.
        observations: ``[B, D]``.

    Returns:
        Sensitivities in the shape of the genome.

    Raises:
        ValueError: If there are no observations.

    Examples:
        >>> def line(genome, x):
        ...     return genome["w"] * x
        >>> genome = TensorDict(w=torch.ones(2))
        >>> rows = torch.tensor([[3.0, 0.0], [-4.0, 0.0]])
        >>> output_sensitivity(line, genome, rows)["w"]
        tensor([3.5000, 0.0000])
    """
    count = len(observations)
    if count == 0:
        raise ValueError("observations is empty: there is nothing to be sensitive to")
    leaves = dict(genome.items(include_nested=True, leaves_only=True))
    names = list(leaves)

    def of_one(
        weights: tuple[torch.Tensor, ...], observation: torch.Tensor
    ) -> torch.Tensor:
        nested = TensorDict()
        for name, weight in zip(names, weights, strict=True):
            nested.set(name, weight)
        return outputs(nested, observation)

    jacobian = torch.vmap(torch.func.jacrev(of_one), in_dims=(None, 0))
    weights = tuple(leaves[name].detach() for name in names)
    sums = [
        [part.abs().sum(dim=0) for part in jacobian(weights, rows)]
        for rows in observations.split(_ROWS_AT_A_TIME)
    ]
    result = genome.clone()
    for name, *parts in zip(names, *sums, strict=True):
        mean = torch.stack(parts).sum(dim=0) / count
        result.set(name, mean.square().sum(dim=0).sqrt())
    return result


def divide_by_sensitivity(
    changes: TensorDictBase, sensitivity: TensorDictBase, *, floor: float = 0.1
) -> TensorDictBase:
    """Shrink changes of weights that the outputs depend on much.

    Each change is divided by the weight's sensitivity relative to the root mean square of
    all weights' sensitivities, but by no less than ``floor``: a weight that hardly
    matters for these observations may matter for others. A weight that no output depends
    on does not change at all, for what its change does cannot be measured.

    Args:
        changes: Of genomes, ``[P]``.
        sensitivity: Of each weight, batch size ``[]``; see :func:`output_sensitivity`.
        floor: Least relative sensitivity, > 0.

    Returns:
        Changes ``[P]``; the arguments are not modified.

    Raises:
        ValueError: If ``floor`` is not positive.

    Examples:
        >>> changes = TensorDict(w=torch.ones(1, 3), batch_size=[1])
        >>> sensitivity = TensorDict(w=torch.tensor([1.0, 7.0, 0.0]))
        >>> divide_by_sensitivity(changes, sensitivity)["w"]
        tensor([[4.0825, 0.5832, 0.0000]])
    """
    if not floor > 0.0:
        raise ValueError(f"floor={floor} must be > 0")
    leaves = list(sensitivity.values(include_nested=True, leaves_only=True))
    count = sum(leaf.numel() for leaf in leaves)
    squares = torch.stack([leaf.square().sum() for leaf in leaves]).sum()
    typical = (squares / count).sqrt()

    def divide(change: torch.Tensor, sensitive: torch.Tensor) -> torch.Tensor:
        divided = change / (sensitive / typical).clamp_min(floor)
        return torch.where(sensitive > 0.0, divided, 0.0)

    return changes.apply(divide, sensitivity.expand(changes.batch_size))
