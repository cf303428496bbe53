"""Parts of the water task that are only drawn: sky, sea, the goal's buoy, the vessel."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np

from gdrl_tasks.engines.scenery import PAINTED, USUAL_PICTURE, VISIBLE_ONLY
from gdrl_tasks.water.hull import Hull

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
_SUN = (0.5, 0.35, -1.0)
_SHADOW_REACH_M = 4.5
_YELLOW, _DARK = [0.95, 0.74, 0.08, 1.0], [0.13, 0.15, 0.18, 1.0]
_WHITE, _METAL = [0.93, 0.94, 0.95, 1.0], [0.66, 0.69, 0.72, 1.0]
_RED, _BLACK = [0.85, 0.2, 0.08, 1.0], [0.05, 0.05, 0.06, 1.0]
_GOAL_COLOUR = [0.95, 0.3, 0.1]

_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
_SPHERE, _ELLIPSOID = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID
_MESH = mujoco.mjtGeom.mjGEOM_MESH

# Sections of a pontoon from the transom to the stem: place along its length, half its
# beam, and distances of keel and deck from the lowest and the highest point, all as
# shares of the whole.
_SECTIONS = np.array(
    [
        [0.00, 0.86, 0.10, 0.16],
        [0.08, 1.00, 0.02, 0.16],
        [0.55, 1.00, 0.00, 0.16],
        [0.70, 0.90, 0.02, 0.14],
        [0.82, 0.66, 0.10, 0.10],
        [0.91, 0.38, 0.26, 0.06],
        [0.97, 0.16, 0.48, 0.02],
        [1.00, 0.03, 0.70, 0.00],
    ]
)
_SECTION_POINTS = 15


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
    # The sky's colour at the horizon: any other colour would give a stripe.
    horizon = 0.5 * (np.array(_ZENITH) + _NADIR)
    visual.rgba.haze = [*horizon, 1.0]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=_ZENITH,
        rgb2=_NADIR,
        width=128,
        height=768,
    )
    _add_sea(spec)
    fovy = 45.0
    height = (farthest_goal_m + 1.0) / math.tan(0.5 * math.radians(fovy))
    spec.worldbody.add_camera(
        name="top", pos=[0.0, 0.0, height], xyaxes=[1, 0, 0, 0, 1, 0], fovy=fovy
    )
    goal = spec.worldbody.add_body(name="goal", mocap=True)
    mark = 0.015 * farthest_goal_m
    for name, shape, size, at, opacity in (
        ("goal_buoy", _SPHERE, [0.16, 0.0, 0.0], 0.03, 1.0),
        ("goal_pole", _CYLINDER, [0.025, 0.45, 0.0], 0.45, 1.0),
        ("goal_mark", _SPHERE, [mark, 0.0, 0.0], 0.9 + mark, 1.0),
        ("goal_ring", _CYLINDER, [goal_tolerance_m, 0.04, 0.0], 0.06, 0.35),
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


def add_vessel(spec: mujoco.MjSpec, body: mujoco.MjsBody, hull: Hull) -> None:
    """Add a catamaran with ducted propellers, a camera behind it, and the sun.

    Args:
        spec: The model.
        body: Body of the hull; its bow points to +x.
        hull: Dimensions.
    """
    body.add_camera(
        name="chase",
        pos=[-3.0, 0.0, 1.9],
        xyaxes=[0.0, -1.0, 0.0, 0.43, 0.0, 0.9],
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
    )
    # The sun follows the vessel, so that the shadow map can be small.
    body.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        pos=[-8.0 * x for x in _SUN],
        dir=_SUN,
        diffuse=[0.6, 0.595, 0.585],
        specular=[0.35, 0.35, 0.33],
        castshadow=True,
    )
    keel = hull.points[0, 2] - 0.5 * hull.draft_m
    half_length = 0.5 * (hull.points[-1, 0] - hull.points[0, 0] + hull.spacing_m)
    vertices, faces = _pontoon(2.0 * half_length, 0.112, 0.27)
    spec.add_mesh(name="pontoon", uservert=vertices.ravel(), userface=faces.ravel())

    def add(name: str, shape: mujoco.mjtGeom, colour: list[float], **where: object) -> None:
        body.add_geom(name=name, type=shape, rgba=colour, **where, **VISIBLE_ONLY)

    deck = keel + 0.3
    for side, sign in (("port", 1.0), ("starboard", -1.0)):
        across = sign * hull.lever_m
        body.add_site(name=f"{side}_thruster", pos=[-0.53, across, hull.thrust_height_m])
        place = [-half_length, across, keel]
        add(f"{side}_hull", _MESH, _YELLOW, meshname="pontoon", pos=place)
        strip = [0.42, 0.028, 0.008]
        place = [-0.2, across, keel + 0.232]
        add(f"{side}_deck", _BOX, _DARK, size=strip, pos=place)
        _add_thruster(add, side, [-half_length - 0.07, across, keel + 0.1])
    for name, along in (("fore_beam", 0.24), ("aft_beam", -0.38)):
        ends = [along, -hull.lever_m, deck - 0.04, along, hull.lever_m, deck - 0.04]
        add(name, _CYLINDER, _METAL, fromto=ends, size=[0.024, 0.0, 0.0])
    add("deck", _BOX, _DARK, size=[0.36, 0.27, 0.012], pos=[-0.07, 0.0, deck])
    white = [0.12, 0.1, 0.06]
    add("case", _BOX, _WHITE, size=white, pos=[0.02, 0.0, deck + 0.07])
    add("lid", _BOX, _METAL, size=[0.125, 0.105, 0.008], pos=[0.02, 0.0, deck + 0.135])
    vertices, faces = _arrow(0.34, 0.27, 0.026)
    spec.add_mesh(name="bow_mark", uservert=vertices.ravel(), userface=faces.ravel())
    place = [0.23, 0.0, deck - 0.012]
    add("bow_mark", _MESH, _WHITE, meshname="bow_mark", pos=place)
    battery = [0.09, 0.18, 0.04]
    add(
        "battery",
        _BOX,
        [0.25, 0.28, 0.32, 1.0],
        size=battery,
        pos=[-0.29, 0.0, deck + 0.05],
    )
    mast = [-0.16, 0.0, deck + 0.3]
    add("mast", _CYLINDER, _METAL, size=[0.014, 0.3, 0.0], pos=mast)
    arm = [-0.16, -0.14, deck + 0.52, -0.16, 0.14, deck + 0.52]
    add("arm", _CYLINDER, _METAL, fromto=arm, size=[0.009, 0.0, 0.0])
    place = [-0.16, 0.14, deck + 0.54]
    add("satellite_dome", _ELLIPSOID, _WHITE, size=[0.05, 0.05, 0.03], pos=place)
    antenna = [-0.16, -0.14, deck + 0.52, -0.16, -0.14, deck + 0.86]
    add("antenna", _CYLINDER, _BLACK, fromto=antenna, size=[0.006, 0.0, 0.0])
    add("lamp", _SPHERE, _RED, size=[0.026, 0.0, 0.0], pos=[-0.16, 0.0, deck + 0.62])


def _add_thruster(add: Callable[..., None], side: str, place: list[float]) -> None:
    """A ducted propeller behind a transom, its axis along the vessel."""
    along = [math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]
    x, y, z = place
    add(f"{side}_duct", _CYLINDER, _RED, size=[0.088, 0.05, 0.0], pos=place, quat=along)
    hole = [x - 0.045, y, z]
    add(f"{side}_hole", _CYLINDER, _BLACK, size=[0.072, 0.007, 0.0], pos=hole, quat=along)
    for number in range(3):
        turn = math.radians(15.0 + 120.0 * number)
        up = 0.036 * math.cos(turn), 0.036 * math.sin(turn)
        add(
            f"{side}_blade_{number}",
            _ELLIPSOID,
            _METAL,
            size=[0.006, 0.017, 0.034],
            pos=[x - 0.053, y + up[1], z + up[0]],
            quat=[math.cos(0.5 * turn), -math.sin(0.5 * turn), 0.0, 0.0],
        )
    hub = [x - 0.055, y, z]
    add(f"{side}_hub", _SPHERE, _METAL, size=[0.017, 0.0, 0.0], pos=hub)
    motor = [x + 0.16, y, z + 0.155]
    add(f"{side}_motor", _BOX, _RED, size=[0.09, 0.06, 0.032], pos=motor)


def _arrow(
    length_m: float, half_width_m: float, height_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """A flat wedge that points ahead, its lower edge at x = 0 and z = 0.

    From afar and above nothing else of the vessel tells bow from stern.

    Returns:
        Points ``[V, 3]`` in metres, and triangles ``[F, 3]``.
    """
    outline = [[0.0, half_width_m], [0.0, -half_width_m], [length_m, 0.0]]
    points = np.array([[x, y, z] for z in (0.0, height_m) for x, y in outline])
    sides = [[i, j, j + 3, i + 3] for i, j in ((0, 1), (1, 2), (2, 0))]
    faces = [[2, 1, 0], [3, 4, 5]]
    faces += [[a, b, c] for a, b, c, _ in sides] + [[a, c, d] for a, _, c, d in sides]
    return points, np.array(faces)


def _pontoon(
    length_m: float, half_beam_m: float, height_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """A slender hull with a transom and a pointed bow.

    Its transom is at x = 0 and its keel at z = 0.

    Returns:
        Points ``[V, 3]`` in metres, and triangles ``[F, 3]``.
    """
    angles = np.linspace(0.0, math.pi, _SECTION_POINTS)
    across, down = np.cos(angles), np.sin(angles) ** 0.7
    along, beam, keel, deck = _SECTIONS.T
    depth = (1.0 - deck - keel)[:, None] * height_m
    points = np.stack(
        [
            np.repeat(length_m * along[:, None], _SECTION_POINTS, axis=1),
            half_beam_m * beam[:, None] * across,
            (1.0 - deck)[:, None] * height_m - depth * down,
        ],
        axis=-1,
    )
    number = np.arange(points[..., 0].size).reshape(points.shape[:2])
    aft, fore = number[:-1], number[1:]
    sides = np.concatenate(
        [
            np.stack([aft[:, :-1], fore[:, :-1], fore[:, 1:]], axis=-1).reshape(-1, 3),
            np.stack([aft[:, :-1], fore[:, 1:], aft[:, 1:]], axis=-1).reshape(-1, 3),
        ]
    )
    left, right = number[:, 0], number[:, -1]
    top = np.concatenate(
        [
            np.stack([left[:-1], right[:-1], right[1:]], axis=-1),
            np.stack([left[:-1], right[1:], left[1:]], axis=-1),
        ]
    )
    ends = [
        [[row[0], row[i], row[i + 1]] for i in range(1, _SECTION_POINTS - 1)]
        for row in (number[0], number[-1][::-1])
    ]
    return points.reshape(-1, 3), np.concatenate([sides, top, *map(np.array, ends)])
