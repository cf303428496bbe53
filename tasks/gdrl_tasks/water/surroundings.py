"""Sky, sea and the goal's buoy, which are only drawn."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from gdrl_tasks.engines.scenery import PAINTED, USUAL_PICTURE, VISIBLE_ONLY, add_sky

SEA_TEXTURE = f"{PAINTED}_sea"
SEA_PIXELS = 768
"""Rows and columns of the painted sea."""
SEA_REACH_M = 115.0
"""From the middle of the painted sea to its edge; beyond is a plain of one colour."""
FAR_COLOUR = (0.72, 0.838, 0.98)
"""Colour of the sea near the horizon, where it mirrors the sky."""

_SECTORS, _INNERMOST_M, _OUTERMOST_M = 64, 0.25, 110.0
_PIXEL_SPREAD_M = 5.0
"""To about this distance from its middle, pixels of the painted sea are equally small."""

_ZENITH, _NADIR = (0.36, 0.58, 0.82), (1.0, 1.0, 1.0)
_SHADOW_REACH_M = 4.5
_GOAL_COLOUR = [0.95, 0.3, 0.1]


def sea_places(share: np.ndarray) -> np.ndarray:
    """Distances from the middle of the painted sea, metres, for shares of its reach.

    Shares of -1 and 1 are its edges. Pixels grow with the distance from the middle.
    """
    steepness = math.asinh(SEA_REACH_M / _PIXEL_SPREAD_M)
    return _PIXEL_SPREAD_M * np.sinh(steepness * share)


def sea_mesh() -> np.ndarray:
    """Points of the drawn surface relative to its middle, metres, ``[V, 2]``.

    They lie on rings; the farther away a ring is, the wider is its distance to the next.
    """
    rings = _ring_radii()
    angles = 2.0 * math.pi / _SECTORS * np.arange(_SECTORS)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([np.zeros((1, 2)), (rings[:, None, None] * ring).reshape(-1, 2)])


def _ring_radii() -> np.ndarray:
    growth = 1.0 + 2.0 * math.pi / _SECTORS
    count = math.ceil(math.log(_OUTERMOST_M / _INNERMOST_M) / math.log(growth))
    return np.geomspace(_INNERMOST_M, _OUTERMOST_M, count + 1)


def add_surroundings(
    spec: mujoco.MjSpec, *, farthest_goal_m: float, goal_tolerance_m: float
) -> None:
    """Add sky, sea, the goal's buoy and a camera over them.

    Args:
        spec: The model.
        farthest_goal_m: Farthest goal that the top camera must see, metres.
        goal_tolerance_m: Radius of the ring drawn around the goal, metres.
    """
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = USUAL_PICTURE
    # The sum with the sun is at most 1; above that colours would be cut off.
    visual.headlight.ambient = [0.42, 0.42, 0.42]
    visual.headlight.diffuse = [0.06, 0.06, 0.06]
    visual.headlight.specular = [0.0, 0.0, 0.0]
    visual.quality.shadowsize = 2048
    spec.stat.extent = farthest_goal_m
    spec.stat.center = [0.0, 0.0, 0.0]
    visual.map.znear = 0.01
    visual.map.zfar = 8000.0 / farthest_goal_m
    visual.map.shadowclip = _SHADOW_REACH_M / farthest_goal_m
    visual.map.haze = 0.5
    add_sky(spec, _ZENITH, _NADIR, width=128)
    _add_sea(spec)
    fovy = 45.0
    height = (farthest_goal_m + 1.0) / math.tan(0.5 * math.radians(fovy))
    spec.worldbody.add_camera(
        name="top", pos=[0.0, 0.0, height], xyaxes=[1, 0, 0, 0, 1, 0], fovy=fovy
    )
    goal = spec.worldbody.add_body(name="goal", mocap=True)
    mark = 0.015 * farthest_goal_m
    sphere, cylinder = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER
    for name, shape, size, at, opacity in (
        ("goal_buoy", sphere, [0.16, 0.0, 0.0], 0.03, 1.0),
        ("goal_pole", cylinder, [0.025, 0.45, 0.0], 0.45, 1.0),
        ("goal_mark", sphere, [mark, 0.0, 0.0], 0.9 + mark, 1.0),
        ("goal_ring", cylinder, [goal_tolerance_m, 0.04, 0.0], 0.06, 0.35),
    ):
        goal.add_geom(
            name=name,
            type=shape,
            size=size,
            pos=[0.0, 0.0, at],
            rgba=[*_GOAL_COLOUR, opacity],
            **VISIBLE_ONLY,
        )


def _add_sea(spec: mujoco.MjSpec) -> None:
    """A skin that is moved and painted for every picture, and a plain to the horizon."""
    spec.add_texture(
        name=SEA_TEXTURE,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=FAR_COLOUR,
        rgb2=FAR_COLOUR,
        width=SEA_PIXELS,
        height=SEA_PIXELS,
    )
    water = spec.add_material(name="water", specular=0.0)
    water.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = SEA_TEXTURE
    spec.add_material(name="far_water", rgba=[*FAR_COLOUR, 1.0], specular=0.0)
    spec.worldbody.add_geom(
        name="horizon",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        # Large tiles are drawn in a third of the time of tiles of a metre.
        size=[0.0, 0.0, 500.0],
        material="far_water",
        # Below the deepest trough near the vessel, where the skin hides it.
        pos=[0.0, 0.0, -3.0],
        **VISIBLE_ONLY,
    )
    points = sea_mesh()
    count = len(points)
    steepness = math.asinh(SEA_REACH_M / _PIXEL_SPREAD_M)
    share = np.arcsinh(points / _PIXEL_SPREAD_M) / steepness
    skin = spec.add_skin(name="sea", material="water")
    skin.vert = np.zeros(3 * count)
    skin.texcoord = (0.5 + 0.5 * share).round(5).ravel()
    skin.face = _sea_faces(count)
    skin.bodyname = ["world"]
    skin.bindpos = [0.0, 0.0, 0.0]
    skin.bindquat = [1.0, 0.0, 0.0, 0.0]
    skin.vertid = [list(range(count))]
    skin.vertweight = [[1.0] * count]


def _sea_faces(count: int) -> np.ndarray:
    """Triangles between the rings of :func:`sea_mesh`, ``[3 F]``."""
    rings = 1 + np.arange(count - 1).reshape(-1, _SECTORS)
    following = np.roll(rings, -1, axis=1)
    middle = np.zeros(_SECTORS, dtype=np.int64)
    fan = np.stack([middle, rings[0], following[0]], axis=-1)
    inner, outer = rings[:-1], rings[1:]
    inner_next, outer_next = following[:-1], following[1:]
    one = np.stack([inner, outer, outer_next], axis=-1)
    other = np.stack([inner, outer_next, inner_next], axis=-1)
    return np.concatenate([fan.ravel(), one.ravel(), other.ravel()])
