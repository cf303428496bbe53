"""The definition of what all tasks share: where the goal is, outcome, reward, success.

Pure functions of arrays with a leading world axis ``W``, for NumPy and torch alike (the
array-API subset of both). Engines compute the same with the compiled loops of
:mod:`gdrl_tasks.kernels`, which are tested against these functions. An engine on another
device can call them as they are.
"""

from __future__ import annotations

import enum
from typing import Any

from array_api_compat import array_namespace


class Outcome(enum.IntEnum):
    """How an episode ended; the integer is what simulations report per world."""

    RUNNING = 0
    SUCCESS = 1
    COLLISION = 2
    TIMEOUT = 3
    DIVERGED = 4
    CAPSIZED = 5


def goal_polar(position: Any, yaw: Any, goal: Any) -> tuple[Any, Any]:
    """Goal in the vehicle's polar coordinates.

    Args:
        position: Vehicle positions in the world frame, metres, ``[W, 2]``.
        yaw: Headings, radians, ``[W]``.
        goal: Goal positions in the world frame, metres, ``[W, 2]``.

    Returns:
        Distance in metres ``[W]`` and bearing in radians ``[W]``, in [-pi, pi),
        positive to the left.

    Examples:
        >>> import numpy as np
        >>> goal_polar(np.zeros((1, 2)), np.zeros(1), np.array([[0.0, 2.0]]))
        (array([2.]), array([1.57079633]))
    """
    xp = array_namespace(position, goal)
    offset = goal - position
    distance = xp.hypot(offset[..., 0], offset[..., 1])
    bearing = xp.atan2(offset[..., 1], offset[..., 0]) - yaw
    turn = 2.0 * xp.pi
    return distance, bearing - turn * xp.floor(bearing / turn + 0.5)


def segment_distance(start: Any, end: Any, point: Any) -> Any:
    """Distance from a point to the segment swept by the vehicle.

    Args:
        start: Segment starts, metres, ``[W, 2]``.
        end: Segment ends, metres, ``[W, 2]``; may equal ``start``.
        point: Points, metres, ``[W, 2]``.

    Returns:
        Distances in metres, ``[W]``.

    Examples:
        >>> import numpy as np
        >>> a, b = np.array([[0.0, 0.0]]), np.array([[2.0, 0.0]])
        >>> segment_distance(a, b, np.array([[1.0, 0.5]]))
        array([0.5])
    """
    xp = array_namespace(start, end, point)
    along = end - start
    offset = point - start
    squared = xp.sum(along * along, axis=-1)
    # A vehicle that does not move sweeps a single point, so any fraction is right.
    safe = xp.where(squared > 0.0, squared, xp.ones_like(squared))
    fraction = xp.clip(xp.sum(along * offset, axis=-1) / safe, 0.0, 1.0)
    gap = offset - fraction[..., None] * along
    return xp.hypot(gap[..., 0], gap[..., 1])


def decide_outcome(
    reached: Any, collided: Any, timed_out: Any, diverged: Any, capsized: Any
) -> Any:
    """One outcome per world from five masks ``[W]``, as :class:`Outcome` integers.

    If several are true in the same control step, divergence comes first (positions then
    mean nothing), then capsizing (a vessel upside down has not arrived), then the goal,
    before a collision and the time limit.

    Examples:
        >>> import numpy as np
        >>> yes, no = np.array([True]), np.array([False])
        >>> decide_outcome(yes, no, yes, no, no), decide_outcome(yes, no, yes, no, yes)
        (array([1]), array([5]))
    """
    xp = array_namespace(reached)
    outcome = xp.zeros(reached.shape, dtype=xp.int64)
    for mask, value in (
        (timed_out, Outcome.TIMEOUT),
        (collided, Outcome.COLLISION),
        (reached, Outcome.SUCCESS),
        (capsized, Outcome.CAPSIZED),
        (diverged, Outcome.DIVERGED),
    ):
        outcome = xp.where(mask, xp.full_like(outcome, int(value)), outcome)
    return outcome


def step_reward(outcome: Any, progress: Any, truncates_at_limit: bool) -> Any:
    """Rewards of a control step.

    A step that ends the episode gives 1 at the goal and else -1, without its progress, as
    in the papers. If the step limit truncates an episode, its last step is as any other.

    Args:
        outcome: :class:`Outcome` integers after the step, ``[W]``.
        progress: Rewards for progress towards the goal, ``[W]``.
        truncates_at_limit: Whether the step limit truncates episodes.

    Returns:
        Rewards, ``[W]``.

    Examples:
        >>> import numpy as np
        >>> outcome = np.array([Outcome.RUNNING, Outcome.SUCCESS, Outcome.TIMEOUT])
        >>> step_reward(outcome, np.full(3, 0.5), truncates_at_limit=False)
        array([ 0.5,  1. , -1. ])
    """
    xp = array_namespace(progress)
    goes_on = outcome == int(Outcome.RUNNING)
    if truncates_at_limit:
        goes_on = goes_on | (outcome == int(Outcome.TIMEOUT))
    reached = outcome == int(Outcome.SUCCESS)
    at_end = xp.where(reached, xp.ones_like(progress), -xp.ones_like(progress))
    return xp.where(goes_on, progress, at_end)


def success_weighted_path_length(success: Any, shortest: Any, path: Any) -> Any:
    """SPL per episode: success times shortest over travelled length.

    Anderson et al. 2018, https://arxiv.org/abs/1807.06757.

    Args:
        success: Mask ``[W]``.
        shortest: Shortest path that would have succeeded, metres, ``[W]``.
        path: Path travelled, metres, ``[W]``.

    Returns:
        Values in [0, 1], ``[W]``.

    Examples:
        >>> import numpy as np
        >>> one = np.ones(1)
        >>> success_weighted_path_length(one > 0, 3 * one, 4 * one)
        array([0.75])
    """
    xp = array_namespace(shortest, path)
    longest = xp.maximum(shortest, path)
    ratio = xp.where(longest > 0.0, shortest / xp.where(longest > 0.0, longest, 1.0), 1.0)
    return xp.where(success, ratio, xp.zeros_like(ratio))
