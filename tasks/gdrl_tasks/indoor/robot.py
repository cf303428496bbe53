"""The TurtleBot3 Burger and the room around it as a MuJoCo model.

Numbers are those of ROBOTIS' description (turtlebot3 da785b7) unless a comment says
otherwise; see the README of this folder.
"""

from __future__ import annotations

import mujoco
import numpy as np

from gdrl_tasks.indoor.looks import add_robot_looks, add_wheel_looks
from gdrl_tasks.indoor.obstacles import ABSENT_M, Shapes
from gdrl_tasks.indoor.scenery import (
    OBSTACLE_COLOUR,
    WALL_COLOUR,
    add_corners,
    add_goal_looks,
    add_room_looks,
    add_scan,
)

WHEEL_RADIUS_M = 0.033
WHEEL_SEPARATION_M = 0.160
BODY_X_M = -0.032
"""Distance of the middle of the body, and of the lidar, behind the axle."""
FOOTPRINT_M = 0.11
"""Radius of the disc around the body's middle that holds body and wheels."""
LIDAR_HEIGHT_M = 0.18
BURGER_WHEEL_SPEED_M_S = 0.227
"""Fastest rim speed of the Burger's wheels."""

OBSTACLE_GROUP = 2
"""Group of the geoms that the lidar detects: walls and obstacles."""

_BODY_MASS_KG = 0.8257 + 0.114 + 0.005
_WHEEL_MASS_KG = 0.0285
_CENTRE_OF_MASS_Z_M = 0.06
"""Height above the floor: batteries and motors are low (an estimate)."""
_BODY_SIZE_M = (0.138, 0.178, 0.143)
_CASTER_X_M, _CASTER_RADIUS_M = -0.081, 0.005
# Reflected inertia of a 258:1 gear motor (an estimate); with it the wheels answer a
# command with the time constant of the servo, whatever the softness of the contact.
_ROTOR_INERTIA_KG_M2 = 1e-3
_SERVO_TIME_S = 0.03
# Half of the torque at which a tyre begins to slip. With the servo's stall torque
# (1.4 N m) tyres slip at every change of the turn rate, robots then lose a third of their
# speed, and the engine's solver takes up to seven rounds instead of one or two.
_LARGEST_TORQUE_NM = 0.15
# Stiff: otherwise the weight presses the wheels 2 % of their radius into the floor.
_FLOOR_IMPEDANCE = [0.99, 0.999, 0.001, 0.5, 2.0]

_FLOOR_BIT, _OBSTACLE_BIT = 1, 2


def model_xml(
    shapes: Shapes,
    *,
    half_extent_m: tuple[float, float],
    substep_s: float,
    goal_tolerance_m: float,
) -> str:
    """The MuJoCo model: floor, walls and obstacles, goal, robot.

    Places of walls and obstacles (``geom_pos``, ``geom_quat``) differ by world; geom
    ``i`` of :func:`obstacle_geoms` is shape ``i``.

    Args:
        shapes: Walls and obstacles.
        half_extent_m: Half the arena's length and width.
        substep_s: Physics time step, seconds.
        goal_tolerance_m: Radius of the disc drawn at the goal.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "indoor"
    option = spec.option
    option.timestep = substep_s
    # The explicit integrator is unstable with these wheels at 0.02 s.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    disable = mujoco.mjtDisableBit
    # No reset after divergence: the task must find the diverged state.
    option.disableflags |= disable.mjDSBL_AUTORESET
    # Bounding volumes are compiled for other places than those of the worlds.
    option.disableflags |= disable.mjDSBL_MIDPHASE
    # One robot is one island; looking for more takes a tenth of the time.
    option.disableflags |= disable.mjDSBL_ISLAND
    _add_room(spec, shapes, half_extent_m, goal_tolerance_m)
    _add_robot(spec)
    spec.compile()
    return spec.to_xml()


def obstacle_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Numbers of the geoms of walls and obstacles, in the order of the shapes, ``[N]``."""
    return np.flatnonzero(model.geom_group == OBSTACLE_GROUP)


def _add_room(
    spec: mujoco.MjSpec,
    shapes: Shapes,
    half_extent_m: tuple[float, float],
    goal_tolerance_m: float,
) -> None:
    """Light, floor, walls and obstacles, the goal, and a camera above."""
    add_room_looks(spec, half_extent_m, shapes.height_m)
    world = spec.worldbody
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        # Size of the tiles that are drawn; tiles of a metre take a third of all rendering.
        size=[0.0, 0.0, 20.0],
        material="floor",
        contype=_FLOOR_BIT,
        conaffinity=0,
        # The larger of two geoms' condim holds: the caster must stay without friction.
        condim=1,
    )
    for number, (is_box, half_size) in enumerate(
        zip(shapes.is_box, shapes.half_size, strict=True)
    ):
        shape = mujoco.mjtGeom
        half_height = 0.5 * shapes.height_m
        size = [half_size[0], half_size[1], half_height]
        world.add_geom(
            name=f"obstacle_{number}",
            type=shape.mjGEOM_BOX if is_box else shape.mjGEOM_CYLINDER,
            size=size if is_box else [half_size[0], half_height, 0.0],
            pos=[ABSENT_M, ABSENT_M, half_height],
            # Turned: the compiler marks shapes without a turn, and the engine would then
            # ignore the worlds' own turns.
            quat=[0.96, 0.0, 0.0, 0.28],
            rgba=WALL_COLOUR if number < 4 else OBSTACLE_COLOUR,
            contype=_OBSTACLE_BIT,
            conaffinity=0,
            condim=1,
            group=OBSTACLE_GROUP,
        )
    add_corners(spec, half_extent_m, shapes.height_m)
    add_goal_looks(world.add_body(name="goal", mocap=True), goal_tolerance_m)


def _add_robot(spec: mujoco.MjSpec) -> None:
    """A free body on two driven wheels and a caster; its origin is the axle's middle."""
    x, y, z = (side**2 for side in _BODY_SIZE_M)
    body = spec.worldbody.add_body(
        name="robot",
        pos=[0.0, 0.0, WHEEL_RADIUS_M],
        mass=_BODY_MASS_KG,
        # Inertia of a uniform box of the body's size.
        inertia=np.round(np.array([y + z, x + z, x + y]) * _BODY_MASS_KG / 12.0, 6),
        ipos=[BODY_X_M, 0.0, _CENTRE_OF_MASS_Z_M - WHEEL_RADIUS_M],
        explicitinertial=True,
    )
    body.add_freejoint(name="robot")
    # The footprint is a disc, so obstacles are touched by a sphere. Its widest circle is
    # the footprint, and a sphere is the fastest shape against boxes and cylinders.
    body.add_geom(
        name="bumper",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[FOOTPRINT_M, 0.0, 0.0],
        pos=[BODY_X_M, 0.0, FOOTPRINT_M + 0.01 - WHEEL_RADIUS_M],
        contype=0,
        conaffinity=_OBSTACLE_BIT,
        condim=1,
        mass=0.0,
        group=4,
    )
    body.add_geom(
        name="caster",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[_CASTER_RADIUS_M, 0.0, 0.0],
        pos=[_CASTER_X_M, 0.0, _CASTER_RADIUS_M - WHEEL_RADIUS_M],
        contype=0,
        conaffinity=_FLOOR_BIT,
        condim=1,
        solimp=_FLOOR_IMPEDANCE,
        mass=0.0,
        group=4,
    )
    add_robot_looks(spec, body, middle_x_m=BODY_X_M, floor_z_m=-WHEEL_RADIUS_M)
    add_scan(spec, "robot", [BODY_X_M, 0.0, LIDAR_HEIGHT_M - WHEEL_RADIUS_M])
    gain = _ROTOR_INERTIA_KG_M2 + 0.5 * 1.05 * WHEEL_RADIUS_M**2
    gain = round(gain / _SERVO_TIME_S, 4)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wheel = body.add_body(
            name=f"{side}_wheel",
            pos=[0.0, sign * 0.5 * WHEEL_SEPARATION_M, 0.0],
            mass=_WHEEL_MASS_KG,
            inertia=[8e-6, 1.6e-5, 8e-6],
            ipos=[0.0, 0.0, 0.0],
            explicitinertial=True,
        )
        wheel.add_joint(
            name=f"{side}_wheel",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0.0, 1.0, 0.0],
            armature=_ROTOR_INERTIA_KG_M2,
        )
        # A sphere touches the floor in one point, half the separation from the middle.
        wheel.add_geom(
            name=f"{side}_tyre",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[WHEEL_RADIUS_M, 0.0, 0.0],
            contype=0,
            conaffinity=_FLOOR_BIT,
            condim=3,
            solimp=_FLOOR_IMPEDANCE,
            mass=0.0,
            group=4,
        )
        add_wheel_looks(wheel, side, WHEEL_RADIUS_M)
        servo = spec.add_actuator(
            name=f"{side}_wheel",
            target=f"{side}_wheel",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=True,
            forcerange=[-_LARGEST_TORQUE_NM, _LARGEST_TORQUE_NM],
        )
        servo.set_to_velocity(kv=gain)
