"""Selection of the best member, with its tie rule spelled out. NaN never wins."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from gdrl_torchrl import keys

TIE_RULES: tuple[str, ...] = ("return_then_parent", "parent", "child")


def rank_scores(scores: torch.Tensor) -> torch.Tensor:
    """Scores with NaN turned to minus infinity, so that it ranks last, ``[P]``.

    Examples:
        >>> rank_scores(torch.tensor([1.0, float("nan")]))
        tensor([1., -inf])
    """
    return torch.where(torch.isnan(scores), -torch.inf, scores)


def select_best(
    evaluation: TensorDictBase,
    *,
    parent: int = 0,
    tie_rule: str = "return_then_parent",
) -> int:
    """Index of the member that becomes the agent.

    Args:
        evaluation: Result of a population evaluation ``[P]`` with ``fitness`` and
            ``return_mean``.
        parent: Index of the parent's copy.
        tie_rule: Among members of equal best fitness take: ``return_then_parent``, the
            one with the highest mean return and, if still equal, the parent;
            ``parent``, the parent if it is among them; ``child``, a child if one is
            among them. Where members are still equal, the lowest index wins.

    Returns:
        The index; the parent's if no member has a fitness that is a number.

    Raises:
        ValueError: If ``tie_rule`` is unknown.

    Examples:
        >>> from tensordict import TensorDict
        >>> result = TensorDict(
        ...     fitness=torch.tensor([5.0, 5.0]),
        ...     return_mean=torch.tensor([0.1, 0.2]),
        ...     batch_size=[2],
        ... )
        >>> select_best(result), select_best(result, tie_rule="parent")
        (1, 0)
    """
    if tie_rule not in TIE_RULES:
        raise ValueError(f"tie_rule={tie_rule!r} must be one of {TIE_RULES}")
    fitness = rank_scores(evaluation[keys.FITNESS].reshape(-1))
    best = fitness.max()
    if best == -torch.inf:
        return parent
    candidates = fitness == best
    if tie_rule == "return_then_parent":
        returns = rank_scores(evaluation[keys.RETURN_MEAN].reshape(-1))
        returns = torch.where(candidates, returns, -torch.inf)
        candidates = candidates & (returns == returns.max())
    if tie_rule == "child":
        children = candidates.clone()
        children[parent] = False
        candidates = children if bool(children.any()) else candidates
    elif bool(candidates[parent]):
        return parent
    return int(candidates.nonzero()[0, 0])
