"""The definition of waves and of forces on the hull: Fossen's equations with added mass.

Array functions for NumPy and torch alike. Engines call :mod:`gdrl_tasks.water.kernel`, a
compiled loop that is tested against them.

MuJoCo's rigid body cannot carry a body-frame added mass, so the accelerations are
solved here, (M_RB + M_A) dnu/dt = tau - C nu - D nu_r - g + M_A dnu_w/dt (Fossen 2011,
eq. 8.1 with relative velocity). MuJoCo's rigid body then gets the wrench that gives it
exactly that acceleration.

Damping is taken at the middle of the substep (its slope is added to the mass matrix) and
an episode starts with half a kick. So MuJoCo's semi-implicit step becomes a leapfrog,
which is second-order accurate and allows substeps several times longer.
"""

from __future__ import annotations

import math
from typing import Any

from array_api_compat import array_namespace

from gdrl_tasks.water.hull import GRAVITY_M_S2, WATER_DENSITY_KG_M3, Hull


def wave_phase(sea: dict[str, Any], x: Any, y: Any, time_s: Any) -> Any:
    """Phases of all components at points.

    Args:
        sea: Component arrays ``[W, C]`` by :data:`~gdrl_tasks.water.waves.SEA_FIELDS`.
        x: World x of the points, metres, ``[W, K]``.
        y: World y of the points, metres, ``[W, K]``.
        time_s: Times, seconds, ``[W]``.

    Returns:
        Phases in radians, ``[W, K, C]``.
    """
    moving = sea["phase"] - sea["omega"] * time_s[..., None]
    return (
        x[..., None] * sea["wavenumber_x"][..., None, :]
        + y[..., None] * sea["wavenumber_y"][..., None, :]
        + moving[..., None, :]
    )


def elevation(sea: dict[str, Any], x: Any, y: Any, time_s: Any) -> Any:
    """Height of the surface over still water at points, metres, ``[W, K]``.

    Arguments as in :func:`wave_phase`.
    """
    phase = wave_phase(sea, x, y, time_s)
    xp = array_namespace(phase)
    return xp.sum(sea["amplitude"][..., None, :] * xp.cos(phase), axis=-1)


def advance_thrust(
    hull: Hull, thrust: Any, command: Any, substep_s: float, compensated: bool
) -> tuple[Any, Any]:
    """Advance both thrusters by one substep.

    The commanded thrust is linear outside the dead zone (everywhere when it is
    ``compensated``), weaker astern than ahead, and reached with a first-order lag that
    is integrated exactly.

    Args:
        hull: Thruster constants.
        thrust: Thrust before the substep, N, ``[W, 2]`` (port, starboard).
        command: Commands in [-1, 1], ``[W, 2]``.
        substep_s: Substep, seconds.
        compensated: Whether the dead zone is compensated by the motor controller.

    Returns:
        Mean thrust during the substep and thrust at its end, N, ``[W, 2]`` each.
    """
    xp = array_namespace(thrust)
    size = xp.abs(command)
    if not compensated:
        size = xp.clip((size - hull.dead_zone) / (1.0 - hull.dead_zone), 0.0, None)
    target = xp.where(
        command > 0.0, hull.thrust_ahead_n * size, -hull.thrust_astern_n * size
    )
    ratio = substep_s / hull.thrust_lag_s
    gap = thrust - target
    mean = target + gap * (-math.expm1(-ratio) / ratio)
    return mean, target + gap * math.exp(-ratio)


def hull_wrench(
    hull: Hull,
    sea: dict[str, Any],
    current: Any,
    thrust: Any,
    qpos: Any,
    qvel: Any,
    time_s: Any,
    substep_s: float,
) -> Any:
    """Wrench on the hull for the coming substep.

    Args:
        hull: Constants of the hull.
        sea: Wave components, arrays ``[W, C]`` (see :func:`waves.draw_sea`).
        current: Velocity of the water body in the world frame, m/s, ``[W, 2]``.
        thrust: Mean thrust of the substep, N, ``[W, 2]`` (port, starboard).
        qpos: Position (m) and orientation quaternion of the hull, ``[W, 7]``.
        qvel: World-frame velocity (m/s) and body-frame angular velocity (rad/s),
            ``[W, 6]``.
        time_s: Time since the start of the episode, s, ``[W]``.
        substep_s: Length of the substep that the wrench will act for, s.

    Returns:
        Force (N) and torque (N m) at the centre of gravity in the world frame,
        ``[W, 6]``.
    """
    xp = array_namespace(qpos, thrust)
    rotation = _rotation_matrix(xp, qpos[:, 3:7])
    body_points = xp.asarray(hull.points, dtype=qpos.dtype)
    arm = xp.matmul(body_points[None], xp.permute_dims(rotation, (0, 2, 1)))
    position = qpos[:, None, :3] + arm
    to_world = lambda vector: xp.matmul(rotation, vector[..., None])[..., 0]  # noqa: E731
    to_body = lambda vector: xp.matmul(vector[:, None, :], rotation)[:, 0]  # noqa: E731
    omega_body = qvel[:, 3:]
    omega_world = to_world(omega_body)
    half = 0.5 * substep_s

    # Water at the hull points [W, P]: the surface, and the orbital motion at half draft.
    # The waves travel in the water, and so with the current.
    kx, ky = sea["wavenumber_x"], sea["wavenumber_y"]
    carried = current * time_s[:, None]
    phase = (
        (position[..., 0:1] - carried[:, None, 0:1]) * kx[:, None]
        + (position[..., 1:2] - carried[:, None, 1:2]) * ky[:, None]
        + (sea["phase"] - sea["omega"] * time_s[:, None])[:, None]
    )
    cosine, sine = xp.cos(phase), xp.sin(phase)
    amplitude, frequency = sea["amplitude"], sea["omega"]
    speed = amplitude * frequency * sea["decay"]
    wavenumber = xp.hypot(kx, ky)
    # Wave pressure decays with depth (Smith effect). The lift has the pressure at keel
    # depth (decay squared), the push on the sides the mean over the draft (about decay).
    decay = sea["decay"]
    surface = _sum_components(xp, amplitude * decay * decay, cosine)
    slope_x = -_sum_components(xp, amplitude * decay * kx, sine)
    slope_y = -_sum_components(xp, amplitude * decay * ky, sine)
    rise = _sum_components(xp, speed, sine)
    rise_rate = -_sum_components(xp, speed * frequency, cosine)
    mean = lambda weight, wave: xp.mean(_sum_components(xp, weight, wave), axis=-1)  # noqa: E731
    water_velocity = xp.stack(
        [
            current[:, 0] + mean(speed * kx / wavenumber, cosine),
            current[:, 1] + mean(speed * ky / wavenumber, cosine),
            mean(speed, sine),
        ],
        axis=-1,
    )
    flat = xp.zeros_like(qvel[:, :1])
    water_acceleration = xp.concat(
        [
            mean(speed * frequency * kx / wavenumber, sine)[:, None],
            mean(speed * frequency * ky / wavenumber, sine)[:, None],
            flat,
        ],
        axis=-1,
    )

    # Forces at the points: buoyancy normal to the surface (Froude-Krylov), wave-making
    # damping and added mass on the motion relative to the water (strip theory). All are
    # scaled by the wet share of the point, the mean of both ends of the substep.
    deep = surface - position[..., 2] + 0.5 * hull.draft_m
    lift = WATER_DENSITY_KG_M3 * GRAVITY_M_S2 * hull.point_area_m2
    lift = lift * xp.clip(deep, 0.0, hull.depth_m)
    rising = (
        qvel[:, 2:3]
        + omega_world[:, 0:1] * arm[..., 1]
        - omega_world[:, 1:2] * arm[..., 0]
        - rise
    )
    before = xp.clip((deep + half * rising) / hull.acting_depth_m, 0.0, 1.0)
    after = xp.clip((deep - half * rising) / hull.acting_depth_m, 0.0, 1.0)
    share = 0.5 * (before + after)
    vertical = lift + share * (
        hull.point_added_mass * rise_rate - hull.point_damping * rising
    )
    force_points = xp.stack([-lift * slope_x, -lift * slope_y, vertical], axis=-1)
    force = to_body(xp.sum(force_points, axis=1))
    torque = to_body(xp.sum(_cross(xp, arm, force_points), axis=1))

    # Forces on the whole hull are scaled by the mean share. Water that the hull begins to
    # take along has to be brought to the hull's speed (von Karman 1929); water that the
    # hull leaves behind keeps its speed.
    wetted = xp.mean(share, axis=-1)[:, None]
    taken = xp.clip(xp.mean(after - before, axis=-1), 0.0, None)[:, None] / substep_s
    added = xp.asarray(hull.added_mass, dtype=qpos.dtype)
    linear = xp.asarray(hull.linear_damping, dtype=qpos.dtype)
    quadratic = xp.asarray(hull.quadratic_damping, dtype=qpos.dtype)
    inertia = xp.asarray(hull.inertia, dtype=qpos.dtype)

    # Body frame: relative velocity, drag, thrust, gravity, acceleration of the water.
    relative = to_body(qvel[:, :3] - water_velocity)
    motion = xp.concat([relative, omega_body], axis=-1)
    # Heave, roll and pitch are damped at the points.
    here = xp.asarray([1.0, 1.0, 0.0, 0.0, 0.0, 1.0], dtype=qpos.dtype)
    resists = wetted * here * (linear + quadratic * xp.abs(motion)) + taken * added
    drag = resists * motion
    gravity = to_body(xp.concat([flat, flat, flat - GRAVITY_M_S2], axis=-1))
    inflow = to_body(water_acceleration) * here[:3]
    # Thrust is scaled by the wet share of the hull's stern; upside down there is none.
    stern = xp.stack([share[:, share.shape[1] // 2], share[:, 0]], axis=-1)
    thrust = xp.where(rotation[:, 2, 2:] > 0.0, stern * thrust, 0.0)
    push = thrust[:, 0:1] + thrust[:, 1:2]
    turn = hull.lever_m * (thrust[:, 1:2] - thrust[:, 0:1])

    # Solve for the acceleration, with damping at the middle of the substep.
    slope = wetted * (linear + 2.0 * quadratic * xp.abs(motion)) + taken * added
    stiffness = xp.asarray(hull.stiffness, dtype=qpos.dtype)
    carries = wetted * added
    moves = carries + half * slope + substep_s**2 / 12.0 * wetted * stiffness
    start = xp.where(time_s > 0.0, 1.0, 0.5)[:, None]
    torque = (
        torque
        + xp.concat([flat, hull.thrust_height_m * push, turn], axis=-1)
        - _cross(xp, omega_body, (inertia + carries[:, 3:]) * omega_body)
        - drag[:, 3:]
    )
    spin_rate = start * torque / (inertia + moves[:, 3:])
    # The added mass turns with the hull. Without the Munk moment (see the README) energy is
    # kept by the Coriolis force of the added mass beyond that in surge.
    omega_now = omega_body + half * spin_rate
    force = (
        force
        + xp.concat([push, flat, flat], axis=-1)
        + hull.mass_kg * gravity
        - drag[:, :3]
        + carries[:, :3] * inflow
        + (carries[:, :3] - carries[:, 0:1]) * _cross(xp, omega_now, relative)
    )
    acceleration = start * force / (hull.mass_kg + moves[:, :3])

    # The wrench that gives MuJoCo's rigid body this acceleration.
    rigid_force = hull.mass_kg * (acceleration - gravity)
    rigid_torque = inertia * spin_rate + _cross(xp, omega_body, inertia * omega_body)
    return xp.concat([to_world(rigid_force), to_world(rigid_torque)], axis=-1)


def _sum_components(xp: Any, weight: Any, wave: Any) -> Any:
    """Sum ``wave`` [W, P, C] over components with weights [W, C]."""
    return xp.sum(weight[:, None] * wave, axis=-1)


def _cross(xp: Any, a: Any, b: Any) -> Any:
    return xp.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def _rotation_matrix(xp: Any, quaternion: Any) -> Any:
    """Body-to-world rotation matrices of unit quaternions (w, x, y, z), [W, 3, 3]."""
    w, x, y, z = (quaternion[:, i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
