"""Parts of the Burger that are only drawn: tiers, wheels and lidar; and a camera.

Measures are those of ROBOTIS' drawing: 0.138 m long, 0.178 m wide over the tyres and
0.192 m high, four plates on pillars, the LDS-01 on the uppermost.
"""

from __future__ import annotations

import math

import mujoco

from gdrl_tasks.engines.scenery import VISIBLE_ONLY

TYRE_COLOUR = [0.07, 0.07, 0.08, 1.0]

_CHASE_BEHIND_M, _CHASE_HEIGHT_M, _CHASE_DOWN_DEG = 0.72, 0.5, 21.0
_PLATES_M = (0.012, 0.052, 0.092, 0.134)
"""Heights of the middles of the plates over the floor."""
_PLATE_M = (0.069, 0.065, 0.002)
"""Half the length, width and thickness of a plate."""
_TOP_M = 0.192

_DARK, _GREY = [0.12, 0.12, 0.13, 1.0], [0.36, 0.37, 0.39, 1.0]
_SILVER, _VERMILION = [0.75, 0.76, 0.78, 1.0], [0.9, 0.33, 0.05, 1.0]
_BLUE, _GREEN = [0.1, 0.3, 0.55, 1.0], [0.08, 0.42, 0.22, 1.0]
_BOX, _CYLINDER = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE


def add_robot_looks(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, *, middle_x_m: float, floor_z_m: float
) -> None:
    """Add plates on pillars, the parts on them, the lidar, and a camera behind.

    Args:
        spec: The model.
        body: Body of the robot.
        middle_x_m: Middle of the plates in the body's frame.
        floor_z_m: Height of the floor in the body's frame.
    """
    down = math.radians(_CHASE_DOWN_DEG)
    body.add_camera(
        name="chase",
        pos=[-_CHASE_BEHIND_M, 0.0, floor_z_m + _CHASE_HEIGHT_M],
        xyaxes=[0.0, -1.0, 0.0, math.sin(down), 0.0, math.cos(down)],
        fovy=50.0,
    )
    spec.add_texture(
        name="waffle",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.17, 0.17, 0.18],
        rgb2=[0.27, 0.27, 0.29],
        width=64,
        height=64,
    )
    plate = spec.add_material(name="waffle", texrepeat=[6.0, 6.0], specular=0.2)
    plate.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "waffle"

    def add(
        name: str,
        shape: mujoco.mjtGeom,
        size: list[float],
        place: tuple[float, float, float],
        colour: list[float],
    ) -> None:
        x, y, z = place
        at = [middle_x_m + x, y, floor_z_m + z]
        body.add_geom(name=name, type=shape, size=size, pos=at, rgba=colour, **VISIBLE_ONLY)

    for number, height in enumerate(_PLATES_M):
        body.add_geom(
            name="deck" if number == len(_PLATES_M) - 1 else f"plate_{number}",
            type=_BOX,
            size=_PLATE_M,
            pos=[middle_x_m, 0.0, floor_z_m + height],
            material="waffle",
            **VISIBLE_ONLY,
        )
    half = 0.5 * (_PLATES_M[-1] - _PLATES_M[0])
    for number in range(4):
        x, y = 0.056 * (-1) ** (number // 2), 0.052 * (-1) ** (number % 2)
        middle = _PLATES_M[0] + half
        add(f"pillar_{number}", _CYLINDER, [0.004, half, 0.0], (x, y, middle), _SILVER)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        place = (0.032, 0.037 * sign, 0.033)
        add(f"{side}_motor", _BOX, [0.023, 0.025, 0.017], place, _GREY)
    add("battery", _BOX, [0.03, 0.044, 0.013], (-0.028, 0.0, 0.029), _BLUE)
    add("controller", _BOX, [0.052, 0.036, 0.004], (0.0, 0.0, 0.06), _BLUE)
    add("computer", _BOX, [0.043, 0.029, 0.004], (0.0, 0.0, 0.1), _GREEN)
    add("ports", _BOX, [0.008, 0.025, 0.008], (-0.036, 0.0, 0.109), _SILVER)
    add("bow", _BOX, [0.006, 0.05, 0.0015], (0.06, 0.0, 0.1365), _VERMILION)
    add("lidar_base", _BOX, [0.042, 0.033, 0.01], (-0.006, 0.0, 0.147), _DARK)
    middle, half = 0.5 * (0.157 + _TOP_M), 0.5 * (_TOP_M - 0.157)
    add("lidar", _CYLINDER, [0.034, half, 0.0], (0.0, 0.0, middle), _DARK)
    add("lidar_cap", _CYLINDER, [0.03, 0.001, 0.0], (0.0, 0.0, _TOP_M), _GREY)
    add("ball", _SPHERE, [0.0055, 0.0, 0.0], (-0.049, 0.0, 0.006), _SILVER)


def add_wheel_looks(wheel: mujoco.MjsBody, side: str, radius_m: float) -> None:
    """Add a tyre and a rim with spokes, which show how the wheel turns.

    Args:
        wheel: Body of the wheel, which turns about its y axis.
        side: ``left`` or ``right``.
        radius_m: Radius of the tyre.
    """
    along = [math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]
    sign = 1.0 if side == "left" else -1.0
    for name, shape, size, outwards, colour in (
        ("rim", _CYLINDER, [radius_m, 0.009, 0.0], 0.0, TYRE_COLOUR),
        ("hub", _CYLINDER, [0.7 * radius_m, 0.0005, 0.0], 0.009, _GREY),
        ("cap", _CYLINDER, [0.006, 0.001, 0.0], 0.0095, _SILVER),
    ):
        wheel.add_geom(
            name=f"{side}_{name}",
            type=shape,
            size=size,
            pos=[0.0, sign * outwards, 0.0],
            quat=along,
            rgba=colour,
            **VISIBLE_ONLY,
        )
    for number in range(3):
        turn = math.pi / 3.0 * number
        wheel.add_geom(
            name=f"{side}_spoke_{number}",
            type=_BOX,
            size=[0.66 * radius_m, 0.0012, 0.0025],
            pos=[0.0, sign * 0.0092, 0.0],
            quat=[math.cos(0.5 * turn), 0.0, math.sin(0.5 * turn), 0.0],
            rgba=_DARK,
            **VISIBLE_ONLY,
        )
