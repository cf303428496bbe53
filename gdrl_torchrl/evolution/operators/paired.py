"""Is a child better than its parent? Paired tests on common episodes."""

from __future__ import annotations

import dataclasses

import torch

from gdrl_torchrl.evolution.operators.selection import rank_scores

_MOST_EXACT = 12
"""Up to so many differences every pattern of signs is counted."""


def sign_flip_p_value(
    differences: torch.Tensor, *, generator: torch.Generator, num_draws: int = 4096
) -> float:
    """Probability of a mean at least so large if the differences had random signs.

    One-sided paired permutation test (Fisher 1935), exact for up to 12 differences that
    are not 0 and by random signs beyond.

    Args:
        differences: Child less parent on common episodes, ``[S]``.
        generator: Source of the random signs.
        num_draws: Number of random patterns of signs.

    Returns:
        A p-value in (0, 1]; 1 if a difference is not a number.

    Examples:
        >>> rng = torch.Generator().manual_seed(0)
        >>> sign_flip_p_value(torch.tensor([1.0, 2.0, 1.5, 0.5]), generator=rng)
        0.0625
        >>> sign_flip_p_value(torch.zeros(5), generator=rng)
        1.0
    """
    values = differences.double()
    if bool(torch.isnan(values).any()):
        return 1.0
    values = values[values != 0.0]
    count = len(values)
    if count == 0:
        return 1.0
    # Sums of the same numbers in another order may differ in the last bits.
    observed = values.sum() - 1e-9 * values.abs().sum()
    if count <= _MOST_EXACT:
        patterns = torch.arange(2**count)[:, None] >> torch.arange(count) & 1
        sums = ((2.0 * patterns - 1.0) * values).sum(dim=1)
        return float((sums >= observed).double().mean())
    signs = torch.randint(2, (num_draws, count), generator=generator)
    sums = ((2.0 * signs - 1.0) * values).sum(dim=1)
    # The observed signs are one of the draws, so that the test keeps its level.
    return float(((sums >= observed).sum() + 1) / (num_draws + 1))


@dataclasses.dataclass(frozen=True)
class HalvingPlan:
    """How many episodes decide which child is tested, and how it is tested.

    Children are screened in rounds. After each round the better half stays, until one
    child is left (successive halving, Jamieson and Talwalkar 2016,
    https://arxiv.org/abs/1502.07943). This child and the parent then meet on fresh
    episodes, in up to ``num_looks`` groups. The child wins as soon as the p-value over
    these episodes so far is at most ``level / num_looks``. Since no screening episode is
    among them, a child no better than the parent wins with a probability of at most
    ``level``.

    Examples:
        >>> plan = HalvingPlan()
        >>> plan.rounds(10)
        [(10, 3), (5, 3), (3, 3), (2, 3)]
    """

    screening_trials: int = 3
    """Episodes of every round of screening."""
    test_trials: int = 10
    """Episodes before every look at the test."""
    num_looks: int = 2
    level: float = 0.2

    def __post_init__(self) -> None:
        for name in ("screening_trials", "test_trials", "num_looks"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be >= 1")
        if not 0.0 < self.level < 1.0:
            raise ValueError(f"level={self.level} must be in (0, 1)")

    def rounds(self, num_children: int) -> list[tuple[int, int]]:
        """Children and episodes of each round of screening."""
        rounds = []
        while num_children > 1:
            rounds.append((num_children, self.screening_trials))
            num_children = -(-num_children // 2)
        return rounds


def better_half(scores: torch.Tensor) -> torch.Tensor:
    """Indices of the better half of scores ``[P]``, the middle one included, ascending.

    NaN is the worst; ties go to the lower index.

    Examples:
        >>> better_half(torch.tensor([1.0, 3.0, float("nan"), 3.0, 2.0])).tolist()
        [1, 3, 4]
    """
    order = rank_scores(scores).argsort(descending=True, stable=True)
    return order[: -(-len(scores) // 2)].sort().values
