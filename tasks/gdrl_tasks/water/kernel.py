"""The water forces of one substep as a compiled loop over worlds.

:mod:`gdrl_tasks.water.definition` defines this arithmetic in array functions; a test holds
the two to 1e-12 of each other. There is no fast-math: loops are laid out so that the
compiler may work on several waves or hull points at once without changing any sum. Along
a hull the wave phases are equally spaced, so each sine follows from the one before by a
rotation.
"""

from __future__ import annotations

import math

import numpy as np

from gdrl_tasks.compiled import compiled
from gdrl_tasks.water.hull import GRAVITY_M_S2, WATER_DENSITY_KG_M3, Hull
from gdrl_tasks.water.sines import sines
from gdrl_tasks.water.waves import SEA_FIELDS

_ROW = 64
"""Length of a row of the scratch memory, and so the most points of a hull. It is
a constant, so that the compiler knows that rows do not overlap."""
_SURFACE, _SLOPE_X, _SLOPE_Y, _RISE, _RISE_RATE, _COS, _SIN = (_ROW * i for i in range(7))
_ARM_X, _ARM_Y, _ARM_Z, _FORCE_X, _FORCE_Y, _FORCE_Z = (_ROW * i for i in range(7, 13))
_BEFORE, _AFTER = _COS, _SIN


def substep_constants(hull: Hull, substep_s: float, compensated: bool) -> tuple:
    """The constants of a task in the order that :func:`substep` expects.

    Args:
        hull: The hull.
        substep_s: Length of the substep, seconds.
        compensated: Whether the thrusters' dead zone is compensated.

    Raises:
        ValueError: If the hull has too many points.
    """
    if len(hull.points) > _ROW:
        raise ValueError(f"a hull of {len(hull.points)} points: {_ROW} at most")
    stations = len(hull.points) // 2
    return stations, hull.spacing_m, substep_s, compensated, *hull.as_tuples()


def sea_arrays(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """The wave components ``[W, C]`` of all worlds in the order of the kernel."""
    return tuple(arrays[name] for name in SEA_FIELDS)


@compiled
def substep(
    ids, qpos, qvel, time_s, wrench, thrust, command, current, sea, constants
):  # pragma: no cover - compiled
    """Advance the thrusters and write the wrench of worlds ``ids`` for one substep.

    Args:
        ids: Numbers of the worlds, ``[K]``.
        qpos: Positions of all hulls, ``[W, 7]``.
        qvel: Their velocities, ``[W, 6]``.
        time_s: Times since their episodes began, seconds, ``[W]``.
        wrench: Forces and torques in the world frame, N and N m, ``[W, 6]``, written.
        thrust: Thrust to port and starboard, N, ``[W, 2]``, written.
        command: Commands in [-1, 1], ``[W, 2]``.
        current: Velocities of the water bodies, m/s, ``[W, 2]``.
        sea: :func:`sea_arrays`.
        constants: :func:`substep_constants`.
    """
    stations, spacing, substep_s, compensated, scalars, vectors = constants
    (mass, draft, depth, acting, area, point_damping, point_added) = scalars[:7]
    (lever, thrust_height, ahead, astern, lag, dead_zone) = scalars[7:]
    inertia, added, linear, quadratic, stiffness, points = vectors
    amplitudes, numbers_x, numbers_y, omegas, phases, decays = sea
    components = amplitudes.shape[1]
    count = 2 * stations
    keep = math.exp(-substep_s / lag)
    mean_gap = -math.expm1(-substep_s / lag) / (substep_s / lag)
    half = 0.5 * substep_s
    buoyancy = WATER_DENSITY_KG_M3 * GRAVITY_M_S2 * area
    fuller = 1.0 / acting
    twelfth = substep_s * substep_s / 12.0
    settled_s = half * linear[2] + twelfth * stiffness[2]
    settled_p = half * linear[3] + twelfth * stiffness[3]
    settled_q = half * linear[4] + twelfth * stiffness[4]
    water = np.empty(13 * _ROW)
    angle = np.empty(3 * components)
    cosines, sinuses = np.empty(3 * components), np.empty(3 * components)
    rotation = np.empty((3, 3))
    for world in ids:
        # Thrusters, port and starboard.
        push_port = push_starboard = 0.0
        for side in range(2):
            value = command[world, side]
            size = abs(value)
            if not compensated:
                size = max((size - dead_zone) / (1.0 - dead_zone), 0.0)
            target = ahead * size if value > 0.0 else -astern * size
            gap = thrust[world, side] - target
            mean = target + gap * mean_gap
            thrust[world, side] = target + gap * keep
            if side == 0:
                push_port = mean
            else:
                push_starboard = mean

        # Attitude and hull points.
        w, x, y, z = qpos[world, 3], qpos[world, 4], qpos[world, 5], qpos[world, 6]
        rotation[0, 0] = 1 - 2 * (y * y + z * z)
        rotation[0, 1] = 2 * (x * y - w * z)
        rotation[0, 2] = 2 * (x * z + w * y)
        rotation[1, 0] = 2 * (x * y + w * z)
        rotation[1, 1] = 1 - 2 * (x * x + z * z)
        rotation[1, 2] = 2 * (y * z - w * x)
        rotation[2, 0] = 2 * (x * z - w * y)
        rotation[2, 1] = 2 * (y * z + w * x)
        rotation[2, 2] = 1 - 2 * (x * x + y * y)
        vx, vy, vz = qvel[world, 0], qvel[world, 1], qvel[world, 2]
        p, q, r = qvel[world, 3], qvel[world, 4], qvel[world, 5]
        spin_x = rotation[0, 0] * p + rotation[0, 1] * q + rotation[0, 2] * r
        spin_y = rotation[1, 0] * p + rotation[1, 1] * q + rotation[1, 2] * r

        # Water at the points: one sine and cosine per hull and component, and one for
        # the spacing of points; the others follow by rotation.
        px, py, pz = points[0, 0], points[1, 0], points[2, 0]
        first_x = qpos[world, 0] + rotation[0, 0] * px + rotation[0, 1] * py
        first_y = qpos[world, 1] + rotation[1, 0] * px + rotation[1, 1] * py
        first_x += rotation[0, 2] * pz
        first_y += rotation[1, 2] * pz
        # The waves travel in the water, and so with the current.
        first_x -= current[world, 0] * time_s[world]
        first_y -= current[world, 1] * time_s[world]
        across = points[1, stations] - py
        other_x = first_x + rotation[0, 1] * across
        other_y = first_y + rotation[1, 1] * across
        along_x, along_y = spacing * rotation[0, 0], spacing * rotation[1, 0]
        for c in range(components):
            kx, ky = numbers_x[world, c], numbers_y[world, c]
            moving = phases[world, c] - omegas[world, c] * time_s[world]
            angle[c] = kx * along_x + ky * along_y
            angle[components + c] = kx * first_x + ky * first_y + moving
            angle[2 * components + c] = kx * other_x + ky * other_y + moving
        sines(angle, cosines, sinuses)
        water[:_COS] = 0.0
        water_vx, water_vy, water_vz = current[world, 0], current[world, 1], 0.0
        water_ax, water_ay = 0.0, 0.0
        for c in range(components):
            amplitude = amplitudes[world, c]
            if amplitude == 0.0:
                continue
            kx, ky = numbers_x[world, c], numbers_y[world, c]
            omega = omegas[world, c]
            pushing = amplitude * decays[world, c]
            lifting = pushing * decays[world, c]
            speed = pushing * omega
            pushing_x, pushing_y = pushing * kx, pushing * ky
            speed_rate = speed * omega
            step_cos, step_sin = cosines[c], sinuses[c]
            cosine, sine = cosines[components + c], sinuses[components + c]
            other_cos, other_sin = cosines[2 * components + c], sinuses[2 * components + c]
            cos_sum, sin_sum = 0.0, 0.0
            for i in range(stations):
                water[_COS + i], water[_SIN + i] = cosine, sine
                water[_COS + stations + i] = other_cos
                water[_SIN + stations + i] = other_sin
                cos_sum += cosine + other_cos
                sin_sum += sine + other_sin
                turned = cosine * step_cos - sine * step_sin
                sine = sine * step_cos + cosine * step_sin
                cosine = turned
                turned = other_cos * step_cos - other_sin * step_sin
                other_sin = other_sin * step_cos + other_cos * step_sin
                other_cos = turned
            for i in range(count):
                water[_SURFACE + i] += lifting * water[_COS + i]
                water[_SLOPE_X + i] -= pushing_x * water[_SIN + i]
                water[_SLOPE_Y + i] -= pushing_y * water[_SIN + i]
                water[_RISE + i] += speed * water[_SIN + i]
                water[_RISE_RATE + i] -= speed_rate * water[_COS + i]
            scale = speed / (math.sqrt(kx * kx + ky * ky) * count)
            water_vx += scale * kx * cos_sum
            water_vy += scale * ky * cos_sum
            water_ax += scale * omega * kx * sin_sum
            water_ay += scale * omega * ky * sin_sum
            water_vz += speed / count * sin_sum

        # Forces at the points: first each alone, then their sums.
        for i in range(count):
            px, py, pz = points[0, i], points[1, i], points[2, i]
            ax = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
            ay = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
            az = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
            deep = water[_SURFACE + i] - (qpos[world, 2] + az) + 0.5 * draft
            rising = vz + spin_x * ay - spin_y * ax - water[_RISE + i]
            lift = buoyancy * min(max(deep, 0.0), depth)
            before = min(max((deep + half * rising) * fuller, 0.0), 1.0)
            after = min(max((deep - half * rising) * fuller, 0.0), 1.0)
            waves = point_added * water[_RISE_RATE + i] - point_damping * rising
            water[_ARM_X + i], water[_ARM_Y + i], water[_ARM_Z + i] = ax, ay, az
            water[_BEFORE + i], water[_AFTER + i] = before, after
            water[_FORCE_X + i] = -lift * water[_SLOPE_X + i]
            water[_FORCE_Y + i] = -lift * water[_SLOPE_Y + i]
            water[_FORCE_Z + i] = lift + 0.5 * (before + after) * waves
        fx = fy = fz = 0.0
        tx = ty = tz = 0.0
        shares_before = shares_after = 0.0
        for i in range(count):
            ax, ay, az = water[_ARM_X + i], water[_ARM_Y + i], water[_ARM_Z + i]
            gx, gy, gz = water[_FORCE_X + i], water[_FORCE_Y + i], water[_FORCE_Z + i]
            shares_before += water[_BEFORE + i]
            shares_after += water[_AFTER + i]
            fx += gx
            fy += gy
            fz += gz
            tx += ay * gz - az * gy
            ty += az * gx - ax * gz
            tz += ax * gy - ay * gx
        shares = 0.5 * (shares_before + shares_after) / count
        taken = max(shares_after - shares_before, 0.0) / (count * substep_s)
        push = turn = 0.0
        if rotation[2, 2] > 0.0:
            push_starboard *= 0.5 * (water[_BEFORE] + water[_AFTER])
            push_port *= 0.5 * (water[_BEFORE + stations] + water[_AFTER + stations])
            push = push_port + push_starboard
            turn = lever * (push_starboard - push_port)

        # Into the body frame: force, torque, velocities, gravity.
        force_x = rotation[0, 0] * fx + rotation[1, 0] * fy + rotation[2, 0] * fz
        force_y = rotation[0, 1] * fx + rotation[1, 1] * fy + rotation[2, 1] * fz
        force_z = rotation[0, 2] * fx + rotation[1, 2] * fy + rotation[2, 2] * fz
        torque_x = rotation[0, 0] * tx + rotation[1, 0] * ty + rotation[2, 0] * tz
        torque_y = rotation[0, 1] * tx + rotation[1, 1] * ty + rotation[2, 1] * tz
        torque_z = rotation[0, 2] * tx + rotation[1, 2] * ty + rotation[2, 2] * tz
        dx, dy, dz = vx - water_vx, vy - water_vy, vz - water_vz
        u_r = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
        v_r = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
        s_r = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        inflow_x = rotation[0, 0] * water_ax + rotation[1, 0] * water_ay
        inflow_y = rotation[0, 1] * water_ax + rotation[1, 1] * water_ay
        gravity_x = -GRAVITY_M_S2 * rotation[2, 0]
        gravity_y = -GRAVITY_M_S2 * rotation[2, 1]
        gravity_z = -GRAVITY_M_S2 * rotation[2, 2]
        # The share of the hull in the water, and the water that it begins to take along.
        carried_x, carried_y = shares * added[0], shares * added[1]
        carried_z, carried_p = shares * added[2], shares * added[3]
        carried_q, carried_r = shares * added[4], shares * added[5]
        linear_u, linear_v = shares * linear[0], shares * linear[1]
        linear_r = shares * linear[5]
        quadratic_u = shares * quadratic[0] * abs(u_r)
        quadratic_v = shares * quadratic[1] * abs(v_r)
        quadratic_r = shares * quadratic[5] * abs(r)
        # Accelerations with damping at the middle of the substep; the first substep of
        # an episode is half a kick (leapfrog start).
        start = 1.0 if time_s[world] > 0.0 else 0.5
        lost = half * taken
        lx, ly = (inertia[0] + carried_p) * p, (inertia[1] + carried_q) * q
        lz = (inertia[2] + carried_r) * r
        torque_x -= q * lz - r * ly + taken * added[3] * p
        torque_y -= r * lx - p * lz + taken * added[4] * q
        torque_z -= p * ly - q * lx + (linear_r + quadratic_r + taken * added[5]) * r
        torque_y += thrust_height * push
        torque_z += turn
        slope_p = lost * added[3] + shares * settled_p
        slope_q = lost * added[4] + shares * settled_q
        slope_r = lost * added[5] + half * (linear_r + 2.0 * quadratic_r)
        rate_p = start * torque_x / (inertia[0] + carried_p + slope_p)
        rate_q = start * torque_y / (inertia[1] + carried_q + slope_q)
        rate_r = start * torque_z / (inertia[2] + carried_r + slope_r)
        p_now, q_now, r_now = p + half * rate_p, q + half * rate_q, r + half * rate_r
        force_x += push + mass * gravity_x + carried_x * inflow_x
        force_y += mass * gravity_y + carried_y * inflow_y
        force_z += mass * gravity_z
        force_x -= (linear_u + quadratic_u + taken * added[0]) * u_r
        force_y -= (linear_v + quadratic_v + taken * added[1]) * v_r
        force_z -= taken * added[2] * s_r
        force_y += (carried_y - carried_x) * (r_now * u_r - p_now * s_r)
        force_z += (carried_z - carried_x) * (p_now * v_r - q_now * u_r)
        slope_u = lost * added[0] + half * (linear_u + 2.0 * quadratic_u)
        slope_v = lost * added[1] + half * (linear_v + 2.0 * quadratic_v)
        slope_s = lost * added[2] + shares * settled_s
        rate_x = start * force_x / (mass + carried_x + slope_u)
        rate_y = start * force_y / (mass + carried_y + slope_v)
        rate_z = start * force_z / (mass + carried_z + slope_s)

        # The wrench that gives the rigid body these accelerations, in the world frame.
        hx, hy, hz = inertia[0] * p, inertia[1] * q, inertia[2] * r
        force_x = mass * (rate_x - gravity_x)
        force_y = mass * (rate_y - gravity_y)
        force_z = mass * (rate_z - gravity_z)
        torque_x = inertia[0] * rate_p + q * hz - r * hy
        torque_y = inertia[1] * rate_q + r * hx - p * hz
        torque_z = inertia[2] * rate_r + p * hy - q * hx
        for i in range(3):
            a, b, d = rotation[i, 0], rotation[i, 1], rotation[i, 2]
            wrench[world, i] = a * force_x + b * force_y + d * force_z
            wrench[world, 3 + i] = a * torque_x + b * torque_y + d * torque_z
