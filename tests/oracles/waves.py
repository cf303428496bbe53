"""What linear theory says of a sea, beyond what the water task computes."""

import math

import numpy as np

from gdrl_tasks.water.definition import wave_phase
from gdrl_tasks.water.waves import jonswap


def energy_period(period_s):
    """Energy period, m-1/m0 times 2 pi, of a JONSWAP sea with a peak period, s.

    Up to 12 times the peak's frequency, as seas are drawn.
    """
    ratio = np.linspace(0.3, 12.0, 400_000)
    density = jonswap(ratio, 1.0, 2.0 * math.pi)
    return period_s * np.trapezoid(density / ratio, ratio) / np.trapezoid(density, ratio)


def orbital_velocity(sea, x, y, z, time_s):
    """Water velocity below the surface with Wheeler stretching, m/s, ``[W, K, 3]``.

    Wheeler (1970) measures depth from the instantaneous surface: in deep water the decay
    is exp(k (z - elevation)). Points ``[W, K]`` above the surface count as at the surface;
    components are ``[W, C]`` and times ``[W]``.
    """
    phase = wave_phase(sea, x, y, time_s)
    kx, ky = sea["wavenumber_x"][:, None], sea["wavenumber_y"][:, None]
    amplitude, omega = sea["amplitude"][:, None], sea["omega"][:, None]
    surface = (amplitude * np.cos(phase)).sum(axis=-1)
    depth = np.maximum(surface - z, 0.0)
    wavenumber = np.hypot(kx, ky)
    speed = amplitude * omega * np.exp(-wavenumber * depth[..., None])
    horizontal = speed * np.cos(phase) / wavenumber
    parts = (horizontal * kx, horizontal * ky, speed * np.sin(phase))
    return np.stack([part.sum(axis=-1) for part in parts], axis=-1)
