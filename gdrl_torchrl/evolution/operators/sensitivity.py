"""How much a policy's outputs depend on each weight, and mutations scaled by it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase

_ROWS_AT_A_TIME = 32
"""Gradients of every row, output and weight are in memory at once."""


def output_sensitivity(
    outputs: Callable[[TensorDictBase, torch.Tensor], torch.Tensor],
    genome: TensorDictBase,
    observations: torch.Tensor,
) -> TensorDictBase:
    """Root mean square gradient of a policy's outputs with respect to each weight.

    ``s_w = sqrt(mean_i sum_k (d y_ik / d w)^2)`` over observations i and outputs k: the
    sensitivity of safe mutations (Lehman et al. 2018, https://arxiv.org/abs/1712.06563,
    section 3.1; PDERL's proximal mutation, https://arxiv.org/abs/1906.09807). They add
    gradients; here squares are added, so that gradients of opposite sign do not cancel.

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
        >>> rows = torch.tensor([[3.0, 0.0], [4.0, 0.0]])
        >>> output_sensitivity(line, genome, rows)["w"]
        tensor([3.5355, 0.0000])
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
    total = [torch.zeros_like(weight) for weight in weights]
    for begin in range(0, count, _ROWS_AT_A_TIME):
        part = jacobian(weights, observations[begin : begin + _ROWS_AT_A_TIME])
        for sum_of_squares, gradient in zip(total, part, strict=True):
            sum_of_squares += gradient.square().sum(dim=(0, 1))
    result = genome.clone()
    for name, sum_of_squares in zip(names, total, strict=True):
        result.set(name, (sum_of_squares / count).sqrt())
    return result


def dampen(
    genomes: TensorDictBase,
    mutated: TensorDictBase,
    sensitivity: TensorDictBase,
    *,
    floor: float = 0.1,
) -> TensorDictBase:
    """Shrink mutations of weights that the outputs depend on, and grow the others.

    Every change is divided by the weight's sensitivity relative to the root mean square
    of all weights' sensitivities, but by no less than ``floor``. So a change of a typical
    weight keeps its size, and none grows by more than ``1 / floor``.

    Args:
        genomes: Before the mutation, ``[P]``.
        mutated: After it, ``[P]``.
        sensitivity: Of each weight, batch size ``[]``; see :func:`output_sensitivity`.
        floor: Least relative sensitivity, > 0.

    Returns:
        New genomes ``[P]``. If no output depends on any weight, ``mutated``.

    Raises:
        ValueError: If ``floor`` is not positive.

    Examples:
        >>> before = TensorDict(w=torch.zeros(1, 2), batch_size=[1])
        >>> after = TensorDict(w=torch.ones(1, 2), batch_size=[1])
        >>> dampen(before, after, TensorDict(w=torch.tensor([1.0, 7.0])))["w"]
        tensor([[5.0000, 0.7143]])
    """
    if not floor > 0.0:
        raise ValueError(f"floor={floor} must be > 0")
    leaves = list(sensitivity.values(include_nested=True, leaves_only=True))
    count = sum(leaf.numel() for leaf in leaves)
    squares = torch.stack([leaf.square().sum() for leaf in leaves]).sum()
    typical = (squares / count).sqrt()
    if not typical > 0.0:
        return mutated

    def scale(
        before: torch.Tensor, after: torch.Tensor, sensitive: torch.Tensor
    ) -> torch.Tensor:
        relative = (sensitive / typical).clamp_min(floor)
        return before + (after - before) / relative

    many = sensitivity.expand(genomes.batch_size)
    return genomes.apply(scale, mutated, many)
