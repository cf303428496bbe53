"""Parts of the room that are only drawn: light and colours, the goal's mark, beams."""

from __future__ import annotations

import itertools
import math
from typing import Any

import mujoco
import numpy as np

from gdrl_tasks.engines.scenery import USUAL_PICTURE, VISIBLE_ONLY, add_sky
from gdrl_tasks.indoor.lidar import FARTHEST_M

_VERMILION = [0.9, 0.33, 0.05, 1.0]
WALL_COLOUR = [0.5, 0.53, 0.57, 1.0]
OBSTACLE_COLOUR = [0.3, 0.5, 0.7, 1.0]

_CORNER_COLOUR, _CORNER_M = [0.42, 0.45, 0.49, 1.0], 0.055

_SUN = (0.42, 0.6, -1.0)
"""Direction of the light: from aside, so that all faces of a box differ in brightness."""
_ZENITH, _NADIR = (0.62, 0.74, 0.86), (0.96, 0.97, 0.98)

_TOP_FOVY_DEG = 30.0
_TOP_MARGIN_M = 0.35
"""Width of the floor around the walls in the view from above."""
_TOP_ASPECT = 4.0 / 3.0
"""Width over height of the narrowest picture that holds the arena's length."""

_MOST_BEAMS = 36
"""Most beams that are drawn, evenly chosen; more would hide the floor."""
_BEAM_START_M = 0.04
_BEAM_HALF_WIDTHS_M, _HIT_HALF_WIDTHS_M = [0.003, 0.017], [0.010, 0.030]
"""Widths at the lidar and at its range: thin lines from behind, a pixel from above."""
_BEAM_OPACITY = 0.4
_FADES = np.linspace(0.9, 0.1, 6)
"""Opacity of the parts of a beam that hits nothing, relative to a beam that hits."""


def add_room_looks(
    spec: mujoco.MjSpec, half_extent_m: tuple[float, float], height_m: float
) -> None:
    """Add light, sky, the floor's material and a camera over the whole arena.

    Args:
        spec: The model.
        half_extent_m: Half the arena's length and width.
        height_m: Height of the walls.
    """
    visual = spec.visual
    # The sum with the lamp is at most 1; above that colours would be cut off.
    visual.headlight.ambient = [0.42, 0.42, 0.42]
    visual.headlight.diffuse = [0.1, 0.1, 0.1]
    visual.headlight.specular = [0.0, 0.0, 0.0]
    visual.global_.offwidth, visual.global_.offheight = USUAL_PICTURE
    spec.stat.extent = max(half_extent_m)
    spec.stat.center = [0.0, 0.0, 0.0]
    visual.map.znear = 0.01
    visual.map.zfar = 40.0
    # The corners of the arena, seen from the light.
    visual.map.shadowclip = 1.02 * math.hypot(*half_extent_m) / max(half_extent_m)
    add_sky(spec, _ZENITH, _NADIR, width=64)
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.94, 0.94, 0.93],
        rgb2=[0.88, 0.88, 0.87],
        width=256,
        height=256,
    )
    floor = spec.add_material(
        name="floor", texrepeat=[1.0, 1.0], texuniform=True, specular=0.0
    )
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    spec.worldbody.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[-6.0 * x for x in _SUN],
        dir=_SUN,
        diffuse=[0.59, 0.58, 0.56],
        specular=[0.2, 0.2, 0.2],
        castshadow=True,
    )
    length, width = (half + _TOP_MARGIN_M for half in half_extent_m)
    away = max(width, length / _TOP_ASPECT) / math.tan(0.5 * math.radians(_TOP_FOVY_DEG))
    spec.worldbody.add_camera(
        name="top",
        pos=[0.0, 0.0, height_m + away],
        xyaxes=[1, 0, 0, 0, 1, 0],
        fovy=_TOP_FOVY_DEG,
    )


def add_corners(
    spec: mujoco.MjSpec, half_extent_m: tuple[float, float], height_m: float
) -> None:
    """Add posts at the corners, where overlapping walls would be lit twice.

    Args:
        spec: The model with its walls, whose numbers do not change.
        half_extent_m: Half the arena's length and width.
        height_m: Height of the walls.
    """
    for number, (x, y) in enumerate(itertools.product((-1.0, 1.0), repeat=2)):
        spec.worldbody.add_geom(
            name=f"corner_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[_CORNER_M, _CORNER_M, 0.5 * height_m + 0.002],
            pos=[
                x * (half_extent_m[0] + 0.05),
                y * (half_extent_m[1] + 0.05),
                0.5 * height_m + 0.002,
            ],
            rgba=_CORNER_COLOUR,
            **VISIBLE_ONLY,
        )


def add_goal_looks(goal: mujoco.MjsBody, tolerance_m: float) -> None:
    """Add a disc of the tolerance, and a pole with a ball that is seen over obstacles.

    Args:
        goal: Body of the goal.
        tolerance_m: Radius of the goal.
    """
    cylinder, sphere = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE
    for name, shape, size, middle_m in (
        ("goal_disc", cylinder, [tolerance_m, 0.004, 0.0], 0.004),
        ("goal_pole", cylinder, [0.01, 0.25, 0.0], 0.25),
        ("goal_ball", sphere, [0.045, 0.0, 0.0], 0.5),
    ):
        goal.add_geom(
            name=name,
            type=shape,
            size=size,
            pos=[0.0, 0.0, middle_m],
            rgba=_VERMILION,
            **VISIBLE_ONLY,
        )


def add_scan(spec: mujoco.MjSpec, body: str, lidar_m: list[float]) -> None:
    """Add skins on which :func:`draw_scan` draws beams; they cost the physics nothing.

    Args:
        spec: The model.
        body: Name of the robot's body.
        lidar_m: Place of the lidar in the body's frame, ``[3]``.
    """
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(_MOST_BEAMS)[:, None, None] + triangles).ravel()
    opacities = {"beams": _BEAM_OPACITY, "hits": 0.95}
    opacities |= {f"fading_{i}": _BEAM_OPACITY * fade for i, fade in enumerate(_FADES)}
    for name, opacity in opacities.items():
        skin = spec.add_skin(name=name, rgba=[0.84, 0.12, 0.14, opacity])
        skin.vert = np.zeros(12 * _MOST_BEAMS)
        skin.face = faces
        skin.bodyname = [body]
        # Vertices are given relative to the lidar, as they are bound to the body.
        skin.bindpos = [-x for x in lidar_m]
        skin.bindquat = [1.0, 0.0, 0.0, 0.0]
        skin.vertid = [list(range(4 * _MOST_BEAMS))]
        skin.vertweight = [[1.0] * (4 * _MOST_BEAMS)]


def draw_scan(physics: Any, ranges_m: np.ndarray, angles_rad: np.ndarray) -> None:
    """Bring the drawn beams of a dm_control physics up to date.

    Beams that hit something end there, with a mark; the others fade out.

    Args:
        physics: Physics of :func:`gdrl_tasks.indoor.robot.model_xml`'s model.
        ranges_m: True ranges of the beams where the robot is now, ``[B]``.
        angles_rad: Directions of the beams from straight ahead, ``[B]``.
    """
    count = len(ranges_m)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_BEAMS)).round())
    chosen = chosen.astype(np.int64)
    ranges, angles = ranges_m[chosen], angles_rad[chosen]
    hit = ranges < FARTHEST_M
    size = np.interp(ranges[hit], [0.0, FARTHEST_M], _HIT_HALF_WIDTHS_M)
    strips = {
        "beams": _beams(angles[hit], np.minimum(_BEAM_START_M, ranges[hit]), ranges[hit]),
        "hits": _ribbons(angles[hit], ranges[hit] - size, ranges[hit], size, size),
    }
    ends = np.linspace(_BEAM_START_M, FARTHEST_M, len(_FADES) + 1)
    missed = angles[~hit]
    for i, (start, end) in enumerate(itertools.pairwise(ends)):
        level = np.ones_like(missed)
        strips[f"fading_{i}"] = _beams(missed, start * level, end * level)
    model = physics.model
    for name, vertices in strips.items():
        first = model.skin_vertadr[model.name2id(name, "skin")]
        # Vertices without a beam are in the lidar's middle, where they cover nothing.
        model.skin_vert[first : first + 4 * _MOST_BEAMS] = 0.0
        model.skin_vert[first : first + len(vertices)] = vertices


def _beams(angles: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Strips that grow wider with the distance from the lidar."""
    limits = [0.0, FARTHEST_M]
    widths = [np.interp(at, limits, _BEAM_HALF_WIDTHS_M) for at in (start, end)]
    return _ribbons(angles, start, end, *widths)


def _ribbons(
    angles: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    start_half_width: np.ndarray,
    end_half_width: np.ndarray,
) -> np.ndarray:
    """Corners of level strips along beams ``[B]``, visible from above, ``[4 B, 3]``."""
    level = np.zeros_like(angles)
    along = np.stack([np.cos(angles), np.sin(angles), level], axis=-1)
    aside = np.stack([-np.sin(angles), np.cos(angles), level], axis=-1)
    near, far = start[:, None] * along, end[:, None] * along
    near_side, far_side = start_half_width[:, None] * aside, end_half_width[:, None] * aside
    corners = [near - near_side, far - far_side, far + far_side, near + near_side]
    return np.stack(corners, axis=1).reshape(-1, 3)
