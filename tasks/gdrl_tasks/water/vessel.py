"""The vessel as it is drawn, with its camera and the sun above it."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np

from gdrl_tasks.engines.scenery import VISIBLE_ONLY
from gdrl_tasks.water.hull import Hull

_SUN = (0.5, 0.35, -1.0)
_YELLOW, _DARK = [0.95, 0.74, 0.08, 1.0], [0.13, 0.15, 0.18, 1.0]
_WHITE, _METAL = [0.93, 0.94, 0.95, 1.0], [0.66, 0.69, 0.72, 1.0]
_RED, _BLACK = [0.85, 0.2, 0.08, 1.0], [0.05, 0.05, 0.06, 1.0]

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
