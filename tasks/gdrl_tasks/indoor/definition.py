"""The definition of a collision indoors: the distance to the nearest obstacle.

For NumPy and torch alike. :mod:`gdrl_tasks.indoor.kernel` computes the same in compiled
loops, which are tested against it. What the lidar sees is defined by the engine's own rays.
"""

from __future__ import annotations

from typing import Any

from array_api_compat import array_namespace


def clearance(points: Any, places: Any, is_box: Any, half_size: Any) -> Any:
    """Distance from points to the nearest surface, negative inside an obstacle.

    Args:
        points: Points, metres, ``[W, 2]``.
        places: Places of the shapes around each point, ``[W, N, 4]``.
        is_box: Mask of boxes, ``[N]``.
        half_size: Half sizes, metres, ``[N, 2]``.

    Returns:
        Distances in metres, ``[W]``.

    Examples:
        >>> import numpy as np
        >>> from gdrl_tasks.indoor.obstacles import make_shapes, place
        >>> shapes = make_shapes([(1.0, 0.5)], [0.2], height_m=0.3)
        >>> layout = place([0.0, 5.0], [0.0, 0.0])[None]
        >>> clearance(
        ...     np.array([[4.0, 0.0]]), layout, shapes.is_box, shapes.half_size
        ... ).round(3)
        array([0.8])
    """
    xp = array_namespace(points, places)
    dx = points[:, None, 0] - places[..., 0]
    dy = points[:, None, 1] - places[..., 1]
    cosine, sine = places[..., 2], places[..., 3]
    # In the frame of a box its surface is where one of these two is zero.
    over_x = xp.abs(cosine * dx + sine * dy) - half_size[:, 0]
    over_y = xp.abs(cosine * dy - sine * dx) - half_size[:, 1]
    outside = xp.hypot(xp.clip(over_x, 0.0, None), xp.clip(over_y, 0.0, None))
    box = outside + xp.clip(xp.maximum(over_x, over_y), None, 0.0)
    cylinder = xp.hypot(dx, dy) - half_size[:, 0]
    return xp.min(xp.where(is_box, box, cylinder), axis=-1)
