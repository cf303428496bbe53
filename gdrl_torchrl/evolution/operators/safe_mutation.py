"""Mutations whose effect on a policy's outputs is the same for every child."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from gdrl_torchrl.evolution.operators.sensitivity import (
    Outputs,
    divide_by_sensitivity,
    output_sensitivity,
)

_SMALLEST, _LARGEST = 1e-6, 10.0
"""Root mean square changes of weights between which a child is looked for."""
_TOLERANCE = 0.01
"""Relative error of a child's divergence."""
_MOST_PASSES = 30
"""Halvings of the range, should nothing faster work."""
_FAR = 100.0
"""Logarithm that stands for a divergence that is no number."""


@torch.no_grad()
def output_divergence(
    outputs: Outputs,
    parent: TensorDictBase,
    children: TensorDictBase,
    observations: torch.Tensor,
) -> torch.Tensor:
    """How far the outputs of children are from their parent's.

    ``sqrt(mean_ik (y'_ik - y_ik)^2) / std_ik(y_ik)`` over observations i and outputs k:
    the root mean square change, in standard deviations of the parent's outputs.

    Args:
        outputs: ``(genome, observation [D]) -> [K]``.
        parent: Genome ``[]``.
        children: Genomes ``[P]``.
        observations: ``[B, D]``.

    Returns:
        ``[P]``; not finite where it cannot be measured, as where all outputs of the
        parent are the same.

    Examples:
        >>> from tensordict import TensorDict
        >>> parent = TensorDict(w=torch.ones(1))
        >>> children = TensorDict(w=torch.tensor([[1.0], [3.0]]), batch_size=[2])
        >>> rows = torch.tensor([[-1.0], [1.0]])
        >>> output_divergence(lambda genome, x: genome["w"] * x, parent, children, rows)
        tensor([0.0000, 1.4142])
    """
    of_rows = torch.vmap(outputs, in_dims=(None, 0))
    before = of_rows(parent, observations)
    after = torch.vmap(of_rows, in_dims=(0, None))(children, observations)
    return (after - before).square().flatten(1).mean(dim=1).sqrt() / before.std()


def safe_mutation(
    outputs: Outputs,
    parent: TensorDictBase,
    children: TensorDictBase,
    observations: torch.Tensor,
    *,
    divergence: float,
    floor: float = 0.1,
) -> TensorDictBase:
    """Scale mutations so that every child's outputs differ from its parent's by as much.

    Two safe mutations of Lehman et al. (GECCO 2018, https://arxiv.org/abs/1712.06563), one
    after the other. Each weight's change is divided by its sensitivity (SM-G-ABS), see
    :func:`~gdrl_torchrl.evolution.operators.sensitivity.divide_by_sensitivity`. Then a
    search finds the factor of a child's whole change at which its
    :func:`output_divergence` is the target (SM-R, "rescaling"). In their code the change
    of outputs is absolute, the mean over observations of its Euclidean norm; here it is
    relative, for values of actions have the unit of rewards.

    Args:
        outputs: ``(genome, observation [D]) -> [K]``, differentiable.
        parent: Genome ``[]``.
        children: Its children after any mutation, ``[P]``; how large that was does not
            matter.
        observations: Observations that the outputs are compared on, ``[B, D]``.
        divergence: Target of :func:`output_divergence`, > 0, met within 1 %.
        floor: As of ``divide_by_sensitivity``.

    Returns:
        New children ``[P]``. A child stays its parent if no root mean square change of its
        weights between 1e-6 and 10 meets the target.

    Raises:
        ValueError: If ``divergence`` or ``floor`` is not positive, or there are no
            observations.

    Examples:
        >>> from tensordict import TensorDict
        >>> parent = TensorDict(w=torch.ones(1))
        >>> children = TensorDict(w=torch.tensor([[1.1], [-7.0]]), batch_size=[2])
        >>> rows = torch.tensor([[-1.0], [1.0]])
        >>> safe_mutation(
        ...     lambda genome, x: genome["w"] * x, parent, children, rows, divergence=0.5
        ... )["w"].round(decimals=1)
        tensor([[1.7000],
                [0.3000]])
    """
    # Most runs have no use for it, and its import takes half a second.
    from scipy.optimize import elementwise

    if not divergence > 0.0:
        raise ValueError(f"divergence={divergence} must be > 0")
    count = len(children)
    changes = children - parent.expand(count)
    sensitivity = output_sensitivity(outputs, parent, observations)
    directions = _of_unit_size(divide_by_sensitivity(changes, sensitivity, floor=floor))

    def moved(scales: np.ndarray, members: np.ndarray) -> TensorDictBase:
        directed: Any = directions[torch.from_numpy(members)]
        factors = torch.from_numpy(scales)

        def move(start: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
            factor = factors.to(step).reshape(-1, *[1] * (step.ndim - 1))
            return start + factor * step

        return parent.expand(len(members)).apply(move, directed)

    def excess(log_scales: np.ndarray, members: np.ndarray) -> np.ndarray:
        found = output_divergence(
            outputs, parent, moved(np.exp(log_scales), members), observations
        )
        logarithm = (found / divergence).log().double()
        # What cannot be measured is too far, so that a smaller scale is tried.
        return logarithm.nan_to_num(_FAR, _FAR, -_FAR).numpy()

    everyone = np.arange(count)
    bounds = np.full((2, count), [[math.log(_SMALLEST)], [math.log(_LARGEST)]])
    root: Any = elementwise.find_root(
        excess,
        tuple(bounds),
        args=(everyone,),
        tolerances={"fatol": _TOLERANCE, "frtol": 0.0, "xatol": 0.0, "xrtol": 0.0},
        maxiter=_MOST_PASSES,
    )
    met = torch.from_numpy(np.abs(root.f_x) <= _TOLERANCE)

    def choose(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
        return torch.where(met.reshape(-1, *[1] * (end.ndim - 1)), end, start)

    return parent.expand(count).apply(choose, moved(np.exp(root.x), everyone))


def _of_unit_size(changes: TensorDictBase) -> TensorDictBase:
    """Changes ``[P]`` whose weights have a root mean square of 1 in each member."""
    leaves = list(changes.values(include_nested=True, leaves_only=True))
    rows = torch.cat([leaf.flatten(1) for leaf in leaves], dim=1)
    size = rows.square().mean(dim=1).sqrt()
    # No change has no direction: it stays 0.
    size = torch.where(size > 0.0, size, 1.0)
    return changes.apply(lambda leaf: leaf / size.reshape(-1, *[1] * (leaf.ndim - 1)))
