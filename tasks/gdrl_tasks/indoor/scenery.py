"""What only the eye sees: light and colours, the goal's mark, cameras, lidar beams."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from gdrl_tasks.indoor.lidar import FARTHEST_M

WALL_COLOUR = [0.36, 0.4, 0.45, 1.0]
OBSTACLE_COLOUR = [0.36, 0.55, 0.72, 1.0]
TYRE_COLOUR = [0.1, 0.1, 0.11, 1.0]
VISIBLE_ONLY = {"contype": 0, "conaffinity": 0, "group": 1, "mass": 0.0}
"""Of geoms that touch nothing, weigh nothing and are not seen by the lidar."""

_DARK, _GREY = [0.17, 0.18, 0.2, 1.0], [0.5, 0.52, 0.55, 1.0]
_YELLOW, _VERMILION = [0.96, 0.78, 0.12, 1.0], [0.86, 0.33, 0.05, 1.0]

_TOP_FOVY_DEG = 30.0
_TOP_MARGIN_M = 0.35
"""Of floor around the walls in the view from above."""
_TOP_ASPECT = 4.0 / 3.0
"""Width over height of the narrowest picture that holds the arena's length."""
_CHASE_BEHIND_M, _CHASE_HEIGHT_M, _CHASE_DOWN_DEG = 0.85, 0.62, 24.0

_MOST_BEAMS = 36
"""As many beams are drawn at most, evenly chosen: more hide the floor."""
_BEAM_START_M = 0.06
_BEAM_HALF_WIDTHS_M, _HIT_HALF_WIDTHS_M = [0.003, 0.018], [0.012, 0.035]
"""At the lidar and at its range: thin lines from behind, and a pixel from above."""


def add_room_looks(
    spec: mujoco.MjSpec, half_extent_m: tuple[float, float], height_m: float
) -> None:
    """Add light, sky, the floor's material and a camera over the whole arena.

    Args:
        spec: The model.
        half_extent_m: Half the arena's length and width.
        height_m: Height of the walls.
    """
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.2, 0.2, 0.2]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960
    spec.stat.extent = max(half_extent_m)
    spec.stat.center = [0.0, 0.0, 0.0]
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 40.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.74, 0.86],
        rgb2=[0.93, 0.95, 0.97],
        width=64,
        height=384,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.86, 0.87, 0.88],
        rgb2=[0.81, 0.82, 0.83],
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
        pos=[0.0, 0.0, 6.0],
        # From aside, so that no two faces of a box are equally light.
        dir=[0.3, 0.55, -1.0],
        diffuse=[0.5, 0.5, 0.48],
        specular=[0.1, 0.1, 0.1],
        # Shadows take ten times as long as all the rest where the processor renders.
        castshadow=False,
    )
    length, width = (half + _TOP_MARGIN_M for half in half_extent_m)
    away = max(width, length / _TOP_ASPECT) / math.tan(0.5 * math.radians(_TOP_FOVY_DEG))
    spec.worldbody.add_camera(
        name="top",
        pos=[0.0, 0.0, height_m + away],
        xyaxes=[1, 0, 0, 0, 1, 0],
        fovy=_TOP_FOVY_DEG,
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


def add_robot_looks(
    body: mujoco.MjsBody, *, middle_x_m: float, floor_z_m: float, radius_m: float
) -> None:
    """Add decks with the lidar on top, what is ahead, and a camera behind.

    Args:
        body: Body of the robot.
        middle_x_m: Middle of the footprint in the body's frame.
        floor_z_m: Height of the floor in the body's frame.
        radius_m: Radius of the footprint.
    """
    down = math.radians(_CHASE_DOWN_DEG)
    body.add_camera(
        name="chase",
        pos=[-_CHASE_BEHIND_M, 0.0, floor_z_m + _CHASE_HEIGHT_M],
        xyaxes=[0.0, -1.0, 0.0, math.sin(down), 0.0, math.cos(down)],
        fovy=50.0,
    )
    cylinder, box = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX
    for name, shape, size, ahead_m, height_m, colour in (
        # Instead of the shadow that the lamp does not cast.
        ("footprint", cylinder, [radius_m, 0.001, 0.0], 0.0, 0.002, [0.1, 0.1, 0.12, 0.45]),
        ("core", box, [0.06, 0.062, 0.048], 0.0, 0.085, _GREY),
        ("deck", box, [0.068, 0.068, 0.006], 0.0, 0.135, _YELLOW),
        ("lidar", cylinder, [0.035, 0.018, 0.0], 0.0, 0.16, _DARK),
        ("bow", box, [0.016, 0.03, 0.007], 0.055, 0.136, _VERMILION),
    ):
        body.add_geom(
            name=name,
            type=shape,
            size=size,
            pos=[middle_x_m + ahead_m, 0.0, floor_z_m + height_m],
            rgba=colour,
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
    for name, opacity in (("beams", 0.35), ("hits", 0.9)):
        skin = spec.add_skin(name=name, rgba=[0.84, 0.15, 0.16, opacity])
        skin.vert = np.zeros(12 * _MOST_BEAMS)
        skin.face = faces
        skin.bodyname = [body]
        # Vertices are where they are bound to the body: seen from the lidar.
        skin.bindpos = [-x for x in lidar_m]
        skin.bindquat = [1.0, 0.0, 0.0, 0.0]
        skin.vertid = [list(range(4 * _MOST_BEAMS))]
        skin.vertweight = [[1.0] * (4 * _MOST_BEAMS)]


def draw_scan(physics: Any, ranges_m: np.ndarray, angles_rad: np.ndarray) -> None:
    """Bring the drawn beams of a dm_control physics up to date.

    Args:
        physics: Physics of :func:`gdrl_tasks.indoor.robot.model_xml`'s model.
        ranges_m: What the lidar reports, ``[B]``.
        angles_rad: Directions of the beams from straight ahead, ``[B]``.
    """
    count = len(ranges_m)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_BEAMS)).round())
    chosen = chosen.astype(np.int64)
    ranges, angles = ranges_m[chosen], angles_rad[chosen]
    model = physics.model
    start = np.minimum(_BEAM_START_M, ranges)
    limits = [0.0, FARTHEST_M]
    widths = [np.interp(at, limits, _BEAM_HALF_WIDTHS_M) for at in (start, ranges)]
    beams = _ribbons(angles, start, ranges, *widths)
    size = np.interp(ranges, limits, _HIT_HALF_WIDTHS_M) * (ranges < FARTHEST_M)
    hits = _ribbons(angles, ranges - 2.0 * size, ranges, size, size)
    for name, vertices in (("beams", beams), ("hits", hits)):
        first = model.skin_vertadr[model.name2id(name, "skin")]
        # Those without a beam stay in the lidar's middle, where they cover nothing.
        model.skin_vert[first : first + 4 * _MOST_BEAMS] = 0.0
        model.skin_vert[first : first + len(vertices)] = vertices


def _ribbons(
    angles: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    start_half_width: np.ndarray,
    end_half_width: np.ndarray,
) -> np.ndarray:
    """Corners of level strips along beams ``[B]``, to be seen from above, ``[4 B, 3]``."""
    level = np.zeros_like(angles)
    along = np.stack([np.cos(angles), np.sin(angles), level], axis=-1)
    aside = np.stack([-np.sin(angles), np.cos(angles), level], axis=-1)
    near, far = start[:, None] * along, end[:, None] * along
    near_side, far_side = start_half_width[:, None] * aside, end_half_width[:, None] * aside
    corners = [near - near_side, far - far_side, far + far_side, near + near_side]
    return np.stack(corners, axis=1).reshape(-1, 3)
