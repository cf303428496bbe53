"""What only the eye sees: the drawn sea surface, the floating goal, the chase camera."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from gdrl_tasks.task import WorldArrays
from gdrl_tasks.water.model import WATER_COLOUR
from gdrl_tasks.water.waves import elevation

_CHASE_BEHIND_M = 3.4
_CHASE_HEIGHT_M = 1.7
_CHASE_AHEAD_M = 2.2


def surface_grid(
    sea: dict[str, np.ndarray], x: np.ndarray, y: np.ndarray, time_s: float
) -> np.ndarray:
    """Surface heights of one world over a grid, metres.

    The sum of :func:`gdrl_tasks.water.waves.elevation` as one product of matrices,
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


def draw_sea_surface(physics: Any, arrays: WorldArrays, sea: dict[str, Any]) -> None:
    """Bring sea, goal and chase camera of a dm_control physics up to date.

    Args:
        physics: Physics of :func:`gdrl_tasks.water.model.model_xml`'s model.
        arrays: Arrays of the task, for one world.
        sea: Wave components ``[1, C]``.
    """
    model, data = physics.model, physics.data
    position = data.qpos[:3]
    if not np.isfinite(position).all():
        return
    field = model.name2id("sea", "hfield")
    geom = model.name2id("sea", "geom")
    half_side = model.hfield_size[field, 0]
    # The drawn patch of sea follows a hull that would leave it.
    reach = 0.5 * half_side
    centre = position[:2] - np.clip(position[:2], -reach, reach)
    components = {name: value[0] for name, value in sea.items()}
    side = np.linspace(-half_side, half_side, model.hfield_nrow[field])
    heights = surface_grid(components, centre[0] + side, centre[1] + side, data.time)
    fraction = (heights - model.geom_pos[geom, 2]) / model.hfield_size[field, 2]
    _write(model.hfield_data, model.hfield_adr[field], np.clip(fraction, 0.0, 1.0))
    texture = model.name2id("water", "texture")
    side = np.linspace(-half_side, half_side, model.tex_width[texture])
    heights = surface_grid(components, centre[0] + side, centre[1] + side, data.time)
    # A texture's first row is the field's last.
    colours = _paint(heights, side[1] - side[0])[::-1]
    _write(model.tex_data, model.tex_adr[texture], colours)
    model.geom_pos[geom, :2] = centre
    goal = arrays["goal"]
    time_s = np.array([data.time])
    data.mocap_pos[0, 2] = elevation(sea, goal[:, :1], goal[:, 1:], time_s)[0, 0]
    mujoco.mj_kinematics(model.ptr, data.ptr)
    mujoco.mj_camlight(model.ptr, data.ptr)
    _place_chase_camera(model, data)
    if physics.contexts:
        target = physics.contexts.mujoco.ptr
        with physics.contexts.gl.make_current() as context:
            context.call(mujoco.mjr_uploadHField, model.ptr, target, field)
            context.call(mujoco.mjr_uploadTexture, model.ptr, target, texture)


def _paint(heights: np.ndarray, spacing_m: float) -> np.ndarray:
    """Colours of the surface, light on slopes that face the sun, ``[N, N, 3]``."""
    slope_y, slope_x = np.gradient(heights, spacing_m)
    light = np.clip(0.9 * slope_x + 0.6 * slope_y + 0.8 * heights, -0.4, 0.6)[..., None]
    water = np.array(WATER_COLOUR)
    colour = water + np.where(light > 0.0, 1.0 - water, water) * light
    return (255.0 * colour).astype(np.uint8)


def _write(target: np.ndarray, start: int, values: np.ndarray) -> None:
    target[start : start + values.size] = values.ravel()


def _place_chase_camera(model: Any, data: Any) -> None:
    """Behind and above the hull, turning with its heading but not with the waves."""
    w, x, y, z = data.qpos[3:7]
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
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
