"""The water forces of one substep as a compiled loop over worlds.

The same arithmetic as :mod:`gdrl_tasks.water.hydrodynamics`, which is its definition:
a test holds the two together to 1e-12. No fast-math. Along a hull the wave phases are
equally spaced, so their sines follow from one another by rotation.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from gdrl_tasks.water.hull import GRAVITY_M_S2, WATER_DENSITY_KG_M3, Hull
from gdrl_tasks.water.waves import SEA_FIELDS


def hull_constants(hull: Hull) -> tuple:
    """The constants of a hull in the order that :func:`substep` expects."""
    stations = hull.points.shape[0] // 2
    scalars = (
        hull.mass_kg,
        hull.draft_m,
        hull.depth_m,
        hull.point_area_m2,
        hull.point_damping,
        hull.point_added_mass,
        hull.lever_m,
        hull.thrust_height_m,
        hull.thrust_ahead_n,
        hull.thrust_astern_n,
        hull.thrust_lag_s,
        hull.dead_zone,
    )
    arrays = (
        hull.inertia,
        hull.added_mass,
        hull.linear_damping,
        hull.quadratic_damping,
        hull.points,
    )
    return stations, hull.spacing_m, scalars, arrays


def sea_arrays(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """The wave components ``[W, C]`` of all worlds in the order of the kernel."""
    return tuple(arrays[name] for name in SEA_FIELDS)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def substep(
    ids,
    qpos,
    qvel,
    time_s,
    xfrc,
    thrust,
    command,
    current,
    sea,
    hull,
    substep_s,
    compensated,
):  # pragma: no cover - compiled
    """Advance the thrusters and write the wrench of worlds ``ids`` for one substep.

    Args:
        ids: World indices, ``[K]``.
        qpos: ``[W, 7]``; qvel ``[W, 6]``; time_s ``[W]``; xfrc ``[W, 6]`` (written).
        qvel: See ``qpos``.
        time_s: See ``qpos``.
        xfrc: See ``qpos``.
        thrust: ``[W, 2]``, written.
        command: ``[W, 2]``.
        current: ``[W, 2]``.
        sea: Six arrays ``[W, C]``.
        hull: :func:`hull_constants`.
        substep_s: Seconds.
        compensated: Whether the dead zone is compensated.
    """
    stations, spacing, scalars, vectors = hull
    (mass, draft, depth, area, point_damping, point_added) = scalars[:6]
    (lever, thrust_height, ahead, astern, lag, dead_zone) = scalars[6:]
    inertia, added, linear, quadratic, points = vectors
    amplitudes, numbers_x, numbers_y, omegas, phases, decays = sea
    components = amplitudes.shape[1]
    count = 2 * stations
    keep = math.exp(-substep_s / lag)
    mean_gap = -math.expm1(-substep_s / lag) / (substep_s / lag)
    half = 0.5 * substep_s
    surface = np.empty(count)
    slope_x = np.empty(count)
    slope_y = np.empty(count)
    rise = np.empty(count)
    rise_rate = np.empty(count)
    rotation = np.empty((3, 3))
    for world in ids:
        # Thrusters.
        push = 0.0
        turn = 0.0
        for side in range(2):
            value = command[world, side]
            size = abs(value)
            if not compensated:
                size = max((size - dead_zone) / (1.0 - dead_zone), 0.0)
            target = ahead * size if value > 0.0 else -astern * size
            gap = thrust[world, side] - target
            mean = target + gap * mean_gap
            thrust[world, side] = target + gap * keep
            push += mean
            turn += mean if side == 1 else -mean
        turn *= lever

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
        # the spacing; the others by rotation.
        surface[:] = 0.0
        slope_x[:] = 0.0
        slope_y[:] = 0.0
        rise[:] = 0.0
        rise_rate[:] = 0.0
        water_vx, water_vy = current[world, 0], current[world, 1]
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
            along = spacing * (kx * rotation[0, 0] + ky * rotation[1, 0])
            step_cos, step_sin = math.cos(along), math.sin(along)
            cos_sum, sin_sum = 0.0, 0.0
            for side in range(2):
                first = side * stations
                px, py, pz = points[first, 0], points[first, 1], points[first, 2]
                start_x = (
                    qpos[world, 0]
                    + rotation[0, 0] * px
                    + rotation[0, 1] * py
                    + rotation[0, 2] * pz
                )
                start_y = (
                    qpos[world, 1]
                    + rotation[1, 0] * px
                    + rotation[1, 1] * py
                    + rotation[1, 2] * pz
                )
                phase = (
                    kx * start_x + ky * start_y + phases[world, c] - omega * time_s[world]
                )
                cosine, sine = math.cos(phase), math.sin(phase)
                for i in range(first, first + stations):
                    surface[i] += lifting * cosine
                    slope_x[i] -= pushing * kx * sine
                    slope_y[i] -= pushing * ky * sine
                    rise[i] += speed * sine
                    rise_rate[i] -= speed * omega * cosine
                    cos_sum += cosine
                    sin_sum += sine
                    turned = cosine * step_cos - sine * step_sin
                    sine = sine * step_cos + cosine * step_sin
                    cosine = turned
            scale = speed / (math.hypot(kx, ky) * count)
            water_vx += scale * kx * cos_sum
            water_vy += scale * ky * cos_sum
            water_ax += scale * omega * kx * sin_sum
            water_ay += scale * omega * ky * sin_sum

        # Forces at the points.
        fx = fy = fz = 0.0
        tx = ty = tz = 0.0
        shares = 0.0
        for i in range(count):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            ax = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
            ay = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
            az = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
            wetted = min(max(surface[i] - (qpos[world, 2] + az) + 0.5 * draft, 0.0), depth)
            share = min(max(wetted / draft, 0.0), 1.0)
            shares += share
            lift = WATER_DENSITY_KG_M3 * GRAVITY_M_S2 * area * wetted
            sinking = vz + spin_x * ay - spin_y * ax - rise[i]
            gx = -lift * slope_x[i]
            gy = -lift * slope_y[i]
            gz = lift + share * (point_added * rise_rate[i] - point_damping * sinking)
            fx += gx
            fy += gy
            fz += gz
            tx += ay * gz - az * gy
            ty += az * gx - ax * gz
            tz += ax * gy - ay * gx
        shares /= count

        # Into the body frame: force, torque, velocities, gravity.
        force_x = rotation[0, 0] * fx + rotation[1, 0] * fy + rotation[2, 0] * fz
        force_y = rotation[0, 1] * fx + rotation[1, 1] * fy + rotation[2, 1] * fz
        force_z = rotation[0, 2] * fx + rotation[1, 2] * fy + rotation[2, 2] * fz
        torque_x = rotation[0, 0] * tx + rotation[1, 0] * ty + rotation[2, 0] * tz
        torque_y = rotation[0, 1] * tx + rotation[1, 1] * ty + rotation[2, 1] * tz
        torque_z = rotation[0, 2] * tx + rotation[1, 2] * ty + rotation[2, 2] * tz
        u = rotation[0, 0] * vx + rotation[1, 0] * vy + rotation[2, 0] * vz
        v = rotation[0, 1] * vx + rotation[1, 1] * vy + rotation[2, 1] * vz
        s = rotation[0, 2] * vx + rotation[1, 2] * vy + rotation[2, 2] * vz
        dx, dy = vx - water_vx, vy - water_vy
        u_r = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * vz
        v_r = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * vz
        s_r = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * vz
        inflow_x = rotation[0, 0] * water_ax + rotation[1, 0] * water_ay
        inflow_y = rotation[0, 1] * water_ax + rotation[1, 1] * water_ay
        gravity_x = -GRAVITY_M_S2 * rotation[2, 0]
        gravity_y = -GRAVITY_M_S2 * rotation[2, 1]
        gravity_z = -GRAVITY_M_S2 * rotation[2, 2]
        centre_x, centre_y, centre_z = q * s - r * v, r * u - p * s, p * v - q * u
        mx, my, mz = added[0] * u_r, added[1] * v_r, added[2] * s_r
        drag_x = linear[0] + quadratic[0] * abs(u_r)
        drag_y = linear[1] + quadratic[1] * abs(v_r)
        drag_r = linear[5] + quadratic[5] * abs(r)
        force_x += push + mass * (gravity_x - centre_x) - (q * mz - r * my)
        force_y += mass * (gravity_y - centre_y) - (r * mx - p * mz)
        force_z += mass * (gravity_z - centre_z) - (p * my - q * mx)
        force_x += added[0] * inflow_x - drag_x * u_r
        force_y += added[1] * inflow_y - drag_y * v_r
        hx, hy, hz = inertia[0] * p, inertia[1] * q, inertia[2] * r
        lx, ly, lz = hx + added[3] * p, hy + added[4] * q, hz + added[5] * r
        torque_x -= q * lz - r * ly
        torque_y += thrust_height * push - (r * lx - p * lz)
        torque_z += turn - (p * ly - q * lx) - drag_r * r

        # Accelerations with damping at the middle of the substep; the first substep of
        # an episode is half a kick (leapfrog start).
        slope_u = linear[0] + 2.0 * quadratic[0] * abs(u_r)
        slope_v = linear[1] + 2.0 * quadratic[1] * abs(v_r)
        slope_r = linear[5] + 2.0 * quadratic[5] * abs(r)
        start = 1.0 if time_s[world] > 0.0 else 0.5
        rate_x = start * force_x / (mass + added[0] + half * slope_u)
        rate_y = start * force_y / (mass + added[1] + half * slope_v)
        rate_z = start * force_z / (mass + added[2] + half * linear[2] * shares)
        rate_p = start * torque_x / (inertia[0] + added[3] + half * linear[3] * shares)
        rate_q = start * torque_y / (inertia[1] + added[4] + half * linear[4] * shares)
        rate_r = start * torque_z / (inertia[2] + added[5] + half * slope_r)

        # The wrench that gives the rigid body these accelerations, in the world frame.
        force_x = mass * (rate_x + centre_x - gravity_x)
        force_y = mass * (rate_y + centre_y - gravity_y)
        force_z = mass * (rate_z + centre_z - gravity_z)
        torque_x = inertia[0] * rate_p + q * hz - r * hy
        torque_y = inertia[1] * rate_q + r * hx - p * hz
        torque_z = inertia[2] * rate_r + p * hy - q * hx
        for i in range(3):
            a, b, d = rotation[i, 0], rotation[i, 1], rotation[i, 2]
            xfrc[world, i] = a * force_x + b * force_y + d * force_z
            xfrc[world, 3 + i] = a * torque_x + b * torque_y + d * torque_z
