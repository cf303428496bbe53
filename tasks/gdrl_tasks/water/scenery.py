"""Updates of what is only drawn: the sea, its foam, the chase camera."""

from __future__ import annotations

import functools
import math
import weakref
from typing import Any

import mujoco
import numpy as np

from gdrl_tasks.spec import WorldArrays
from gdrl_tasks.water.definition import elevation
from gdrl_tasks.water.surroundings import FAR_COLOUR, SEA_TEXTURE, sea_mesh, sea_places
from gdrl_tasks.water.wake import Track, foam

_CHASE_BEHIND_M, _CHASE_HEIGHT_M, _CHASE_AHEAD_M = 3.6, 1.75, 1.9
_CHASE_OFF_AXIS_RAD = 0.35
"""A goal farther aside than this turns the chase camera, so that it stays in view."""
_CHASE_NEAR_M = (1.0, 3.0)
"""Goals nearer than the first distance do not turn it; from the second on they do."""

_HAZE_M = (13.0, 70.0)
"""Distances at which the sea begins to mirror the sky, and mirrors it fully."""
_HAZES = 64
_LIGHTS = 256
_LIGHT_RANGE = (-0.5, 0.75)
_COLOURS = np.array(
    [
        # Light on the slope, and red, green and blue.
        [-0.50, 0.02, 0.15, 0.25],
        [-0.20, 0.06, 0.26, 0.38],
        [0.00, 0.11, 0.36, 0.48],
        [0.20, 0.25, 0.50, 0.61],
        [0.45, 0.52, 0.71, 0.79],
        [0.75, 0.90, 0.95, 0.97],
    ]
)
_TOWARDS_SUN = np.array([0.9, 0.63])
"""Light on a slope of 1 along x and along y."""
_LIGHT_ON_CREST = 0.8
"""Light on a metre of height."""
_FOAM_COLOUR = np.array([235.0, 244.0, 247.0], dtype=np.float32)

_tracks: weakref.WeakKeyDictionary[Any, Track] = weakref.WeakKeyDictionary()


def surface_grid(
    sea: dict[str, np.ndarray], x: np.ndarray, y: np.ndarray, time_s: float
) -> np.ndarray:
    """Surface heights of one world over a grid, metres.

    The sum of :func:`gdrl_tasks.water.definition.elevation` as one product of matrices,
    because cos(a + b) is the real part of exp(ia) exp(ib).

    Args:
        sea: Component arrays ``[C]``.
        x: World x of the columns, metres, ``[N]``.
        y: World y of the rows, metres, ``[M]``.
        time_s: Time, seconds.

    Returns:
        Heights over still water, ``[M, N]``.
    """
    moving = sea["phase"] - sea["omega"] * time_s
    columns = np.exp(1j * (np.outer(sea["wavenumber_x"], x) + moving[:, None]))
    rows = np.exp(1j * np.outer(y, sea["wavenumber_y"])) * sea["amplitude"]
    return np.real(rows @ columns)


def note_track(physics: Any) -> None:
    """Remember where the vessel is, because it leaves its wake there."""
    data = physics.data
    if np.isfinite(data.qpos[:7]).all():
        x, y = data.qpos[:2].tolist()
        _tracks.setdefault(physics, Track()).note(float(data.time), x, y, _heading(data))


def draw_sea_surface(physics: Any, arrays: WorldArrays, sea: dict[str, Any]) -> None:
    """Update sea, wake, goal and chase camera of a dm_control physics.

    Args:
        physics: Physics of :func:`gdrl_tasks.water.model.model_xml`'s model.
        arrays: Arrays of the task, for one world.
        sea: Wave components ``[1, C]``.
    """
    model, data = physics.model, physics.data
    if not np.isfinite(data.qpos[:7]).all():
        return
    note_track(physics)
    components = {name: value[0] for name, value in sea.items()}
    centre = data.qpos[:2].copy()
    skin = model.name2id("sea", "skin")
    first, count = model.skin_vertadr[skin], model.skin_vertnum[skin]
    model.skin_vert[first : first + count] = _surface(components, centre, data.time)
    texture = model.name2id(SEA_TEXTURE, "texture")
    size = model.tex_width[texture]
    # Row 0 of a texture is where its second coordinate is 0.
    picture = _paint(components, centre, data.time, _tracks[physics], size)
    start = model.tex_adr[texture]
    model.tex_data[start : start + picture.size] = picture.ravel()
    goal = arrays["goal"]
    time_s = np.array([data.time])
    data.mocap_pos[0, 2] = elevation(sea, goal[:, :1], goal[:, 1:], time_s)[0, 0]
    mujoco.mj_kinematics(model.ptr, data.ptr)
    mujoco.mj_camlight(model.ptr, data.ptr)
    _place_chase_camera(model, data, goal[0])
    if physics.contexts:
        target = physics.contexts.mujoco.ptr
        with physics.contexts.gl.make_current() as context:
            context.call(mujoco.mjr_uploadTexture, model.ptr, target, texture)


def _surface(sea: dict[str, np.ndarray], centre: np.ndarray, time_s: float) -> np.ndarray:
    """Points of the drawn surface, ``[V, 3]``, without waves too short for its mesh."""
    mesh = _mesh()
    x, y = (centre + mesh).T
    # Points are about a tenth of their distance apart.
    spacing = 0.1 * np.hypot(*mesh.T)
    number = np.hypot(sea["wavenumber_x"], sea["wavenumber_y"])
    moving = sea["phase"] - sea["omega"] * time_s
    angle = np.outer(x, sea["wavenumber_x"]) + np.outer(y, sea["wavenumber_y"]) + moving
    left = sea["amplitude"] * np.exp(-0.5 * (0.5 * np.outer(spacing, number)) ** 2)
    return np.stack([x, y, (left * np.cos(angle)).sum(axis=1)], axis=-1)


@functools.cache
def _mesh() -> np.ndarray:
    return sea_mesh()


@functools.cache
def _pixels(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places and sizes of pixels, metres ``[N]``; first colour by haze ``[N, N]``."""
    places = sea_places(np.linspace(-1.0 + 1.0 / size, 1.0 - 1.0 / size, size))
    away = np.log(np.maximum(np.hypot(places[:, None], places), 1e-3))
    far = np.interp(away, np.log(_HAZE_M), [0.0, 1.0])
    haze = (far * far * (3.0 - 2.0 * far) * (_HAZES - 1)).round()
    return places, np.gradient(places), (_LIGHTS * haze).astype(np.uint16)


@functools.cache
def _palette() -> np.ndarray:
    """Colours by haze and light, four bytes each, ``[hazes * lights]``."""
    light = np.linspace(*_LIGHT_RANGE, _LIGHTS)
    near = [np.interp(light, _COLOURS[:, 0], _COLOURS[:, i]) for i in (1, 2, 3)]
    far = np.linspace(0.0, 1.0, _HAZES)[:, None, None]
    colours = (1.0 - far) * np.stack(near, axis=-1) + far * np.array(FAR_COLOUR)
    opaque = np.concatenate([colours, np.ones((_HAZES, _LIGHTS, 1))], axis=-1)
    # One number for each colour; picking single bytes would take four times as long.
    return (255.0 * opaque).round().astype(np.uint8).view(np.uint32).ravel()


def _paint(
    sea: dict[str, np.ndarray],
    centre: np.ndarray,
    time_s: float,
    track: Track,
    size: int,
) -> np.ndarray:
    """Colours of the surface, bytes ``[N, N, 3]``: the slopes of the waves, and foam.

    A pixel has the mean of its area, so waves fade where pixels are large. The
    sum over the waves is one product of matrices, as in :func:`surface_grid`.
    """
    places, spacing, haze = _pixels(size)
    x, y = centre[0] + places, centre[1] + places
    wavenumber = np.stack([sea["wavenumber_x"], sea["wavenumber_y"]])
    moving = sea["phase"] - sea["omega"] * time_s
    # Light of a wave's slope and height, as real part of its amplitude times exp(ia).
    light = sea["amplitude"] * (_LIGHT_ON_CREST + 1j * (_TOWARDS_SUN @ wavenumber))
    blur = np.exp(-0.5 * (0.6 * wavenumber[:, :, None] * spacing) ** 2)
    columns = np.exp(1j * (np.outer(wavenumber[0], x) + moving[:, None])) * blur[0]
    rows = (np.exp(1j * np.outer(wavenumber[1], y)) * blur[1] * light[:, None]).T
    left = np.concatenate([rows.real, -rows.imag], axis=1).astype(np.float32)
    right = np.concatenate([columns.real, columns.imag]).astype(np.float32)
    low, high = _LIGHT_RANGE
    scale = (_LIGHTS - 1) / (high - low)
    level = (left * scale) @ right
    level -= low * scale
    np.clip(level, 0.0, _LIGHTS - 1.0, out=level)
    number = level.astype(np.uint16)
    number += haze
    picture = _palette()[number].view(np.uint8).reshape(size, size, 4)[..., :3]
    white = foam(track, x, y)
    if white is not None:
        part, cover = picture[white[0], white[1]], white[2][..., None]
        part[...] = part + cover * (_FOAM_COLOUR - part)
    return picture


def _heading(data: Any) -> float:
    w, x, y, z = data.qpos[3:7].tolist()
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _place_chase_camera(model: Any, data: Any, goal: np.ndarray) -> None:
    """Put the camera behind and above the hull, turned so far that the goal is in view.

    The camera turns with the heading but not with the waves.
    """
    heading = _heading(data)
    way = goal - data.qpos[:2]
    bearing = math.atan2(way[1], way[0]) - heading
    bearing = (bearing + math.pi) % (2.0 * math.pi) - math.pi
    turn = bearing - np.clip(bearing, -_CHASE_OFF_AXIS_RAD, _CHASE_OFF_AXIS_RAD)
    yaw = heading + turn * np.interp(math.hypot(*way), _CHASE_NEAR_M, [0.0, 1.0])
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    level = np.array([data.qpos[0], data.qpos[1], 0.0])
    eye = level - _CHASE_BEHIND_M * ahead + _CHASE_HEIGHT_M * up
    back = eye - (level + _CHASE_AHEAD_M * ahead)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    camera = model.name2id("chase", "camera")
    data.cam_xpos[camera] = eye
    data.cam_xmat[camera] = np.stack([right, np.cross(back, right), back], 1).ravel()
