"""The hull: a Heron-sized twin-thruster catamaran and its coefficients.

The horizontal dynamics are the identified Heron (Batista et al.; see the README of this
folder for every number and its source). What the identification lacks is computed here
from strip theory and naval-architecture formulas.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

WATER_DENSITY_KG_M3 = 1000.0
GRAVITY_M_S2 = 9.81


@dataclasses.dataclass(frozen=True)
class HullParameters:
    """Main dimensions and identified coefficients, SI units."""

    mass_kg: float = 35.96
    length_m: float = 1.35
    hull_spacing_m: float = 0.756
    """Distance between the centre lines of the two hulls, twice the thrusters' lever."""
    hull_beam_m: float = 0.224
    depth_m: float = 0.32
    """Height of a hull from keel to deck."""
    waterplane_coefficient: float = 0.7
    centre_of_gravity_m: float = 0.15
    """Height of the centre of gravity above the keel."""
    yaw_inertia_total_kg_m2: float = 10.0
    """Inertia of rigid body and added mass together, that of the nominal Heron."""
    surge_quadratic: float = 17.26
    sway_linear: float = 99.99
    sway_quadratic: float = 99.99
    yaw_linear: float = 0.83
    yaw_quadratic: float = 17.34
    thrust_ahead_n: float = 22.5
    thrust_astern_n: float = 4.5
    thrust_lag_s: float = 0.05
    dead_zone: float = 0.4
    stations: int = 9
    """Hull points along each hull."""
    acting_draft: float = 0.5
    """Wetted depth, divided by the draft, from which on the water acts in full."""


@dataclasses.dataclass(frozen=True, eq=False)
class Hull:
    """Constants of the equations of motion, derived by :func:`make_hull`.

    ``P`` is the number of hull points: ``stations`` along each of the two hulls. A
    point sits at the height of the centre of buoyancy of its section.
    """

    mass_kg: float
    draft_m: float
    depth_m: float
    acting_depth_m: float
    """Wetted depth of a point from which on the water acts on it in full."""
    spacing_m: float
    """Distance between neighbouring points along a hull."""
    inertia: np.ndarray
    """Rigid-body inertia about x, y, z, kg m^2, ``[3]``."""
    added_mass: np.ndarray
    """Added mass in surge, sway, heave (kg) and roll, pitch, yaw (kg m^2), ``[6]``."""
    linear_damping: np.ndarray
    """Linear damping in the same six directions, ``[6]``."""
    quadratic_damping: np.ndarray
    """Quadratic damping in the same six directions, ``[6]``."""
    stiffness: np.ndarray
    """Stiffness of the waterplane in the same six directions, ``[6]``."""
    points: np.ndarray
    """Positions in the body frame, metres, ``[P, 3]``."""
    point_area_m2: float
    """Waterplane area of one point."""
    point_damping: float
    """Wave-making damping of one point in heave, N s/m."""
    point_added_mass: float
    """Added mass of one point in heave, kg."""
    lever_m: float
    thrust_height_m: float
    """Height of the thrust line in the body frame."""
    thrust_ahead_n: float
    thrust_astern_n: float
    thrust_lag_s: float
    dead_zone: float

    def as_tuples(self) -> tuple[tuple[float, ...], tuple[np.ndarray, ...]]:
        """Numbers and arrays for compiled loops, which take no objects."""
        scalars = (
            self.mass_kg,
            self.draft_m,
            self.depth_m,
            self.acting_depth_m,
            self.point_area_m2,
            self.point_damping,
            self.point_added_mass,
            self.lever_m,
            self.thrust_height_m,
            self.thrust_ahead_n,
            self.thrust_astern_n,
            self.thrust_lag_s,
            self.dead_zone,
        )
        arrays = (
            self.inertia,
            self.added_mass,
            self.linear_damping,
            self.quadratic_damping,
            self.stiffness,
            np.ascontiguousarray(self.points.T),
        )
        return scalars, arrays


def make_hull(parameters: HullParameters | None = None) -> Hull:
    """Derive the constants of the equations of motion.

    Raises:
        ValueError: If no distribution of the mass over the two hulls and the middle
            between them has the yaw inertia.

    Examples:
        >>> hull = make_hull()
        >>> round(hull.draft_m, 3), hull.points.shape
        (0.085, (18, 3))
    """
    p = parameters or HullParameters()
    spacing = p.length_m / p.stations
    along = (np.arange(p.stations) - 0.5 * (p.stations - 1)) * spacing
    across = np.array([-0.5, 0.5]) * p.hull_spacing_m
    waterplane = 2.0 * p.length_m * p.hull_beam_m * p.waterplane_coefficient
    area = waterplane / (2 * p.stations)
    draft = p.mass_kg / (WATER_DENSITY_KG_M3 * waterplane)
    # Sections are treated as half-submerged ellipses: 2-D potential-flow added mass.
    section_heave = WATER_DENSITY_KG_M3 * math.pi * p.hull_beam_m**2 / 8.0
    section_sway = WATER_DENSITY_KG_M3 * math.pi * draft**2 / 2.0
    heave = section_heave * 2.0 * p.length_m * p.waterplane_coefficient
    sway = section_sway * 2.0 * p.length_m
    points = np.stack(
        [np.tile(along, 2), np.repeat(across, p.stations), np.zeros(2 * p.stations)], 1
    )
    points[:, 2] = 0.5 * draft - p.centre_of_gravity_m
    mean_square = np.mean(points**2, axis=0)
    yaw_added = sway * mean_square[0]
    stiffness = WATER_DENSITY_KG_M3 * GRAVITY_M_S2 * waterplane
    natural = math.sqrt(stiffness / (p.mass_kg + heave))
    damping = _section_damping(natural, p.hull_beam_m, draft)
    damping *= 2.0 * p.length_m * p.waterplane_coefficient
    # Damping and added mass in heave, roll and pitch act at the hull points. Their sums
    # for a rigid hull are here because the equations of motion use them implicitly.
    return Hull(
        mass_kg=p.mass_kg,
        draft_m=draft,
        depth_m=p.depth_m,
        acting_depth_m=p.acting_draft * draft,
        spacing_m=spacing,
        # Rounded as in a model's XML, so that both have the same rigid body.
        inertia=np.round(_inertia(p, yaw_added), 3),
        added_mass=np.array(
            [
                0.1 * p.mass_kg,
                sway,
                heave,
                heave * mean_square[1],
                heave * mean_square[0],
                yaw_added,
            ]
        ),
        linear_damping=np.array(
            [
                0.0,
                p.sway_linear,
                damping,
                damping * mean_square[1],
                damping * mean_square[0],
                p.yaw_linear,
            ]
        ),
        quadratic_damping=np.array(
            [p.surge_quadratic, p.sway_quadratic, 0.0, 0.0, 0.0, p.yaw_quadratic]
        ),
        stiffness=stiffness
        * np.array([0.0, 0.0, 1.0, mean_square[1], mean_square[0], 0.0]),
        points=points,
        point_area_m2=area,
        point_damping=damping / (2 * p.stations),
        point_added_mass=heave / (2 * p.stations),
        lever_m=0.5 * p.hull_spacing_m,
        thrust_height_m=-p.centre_of_gravity_m,
        thrust_ahead_n=p.thrust_ahead_n,
        thrust_astern_n=p.thrust_astern_n,
        thrust_lag_s=p.thrust_lag_s,
        dead_zone=p.dead_zone,
    )


def _inertia(p: HullParameters, yaw_added: float) -> np.ndarray:
    """Rigid-body inertia about x, y, z, kg m^2, ``[3]``.

    The two hulls carry their part of the mass evenly over the area of their waterplanes:
    across each hull evenly over its beam, along it as 1 - |2 x / length|^n, which has the
    waterplane coefficient n / (n + 1). The rest is compact and in the middle: payload and
    batteries. All mass is spread evenly from keel to deck. The size of the hulls' part
    follows from the yaw inertia.
    """
    exponent = p.waterplane_coefficient / (1.0 - p.waterplane_coefficient)
    # Mean squares of the distances within the hulls, m^2.
    along = 0.25 * p.length_m**2 * (1.0 / 3.0 - 1.0 / (exponent + 3.0))
    along /= p.waterplane_coefficient
    across = 0.25 * p.hull_spacing_m**2 + p.hull_beam_m**2 / 12.0
    in_hulls = (p.yaw_inertia_total_kg_m2 - yaw_added) / (along + across)
    if not 0.0 <= in_hulls <= p.mass_kg:
        most = yaw_added + p.mass_kg * (along + across)
        raise ValueError(
            f"yaw_inertia_total_kg_m2={p.yaw_inertia_total_kg_m2}: needs {in_hulls:.1f} kg "
            f"in the hulls, of mass_kg={p.mass_kg}; choose {yaw_added:.2f} to {most:.2f}"
        )
    upright = p.mass_kg * p.depth_m**2 / 12.0
    across, along = in_hulls * across, in_hulls * along
    return np.array([across + upright, along + upright, across + along])


def _section_damping(omega: float, beam_m: float, draft_m: float) -> float:
    """Heave damping per metre of a wall-sided section, N s/m^2.

    Radiated energy: b = rho g^2 A^2 / w^3, with the ratio of the radiated wave to the
    heave amplitude A = 2 sin(k b / 2) exp(-k T) (Newman 1977, strip theory).
    """
    wavenumber = omega**2 / GRAVITY_M_S2
    ratio = 2.0 * math.sin(0.5 * wavenumber * beam_m) * math.exp(-wavenumber * draft_m)
    return WATER_DENSITY_KG_M3 * GRAVITY_M_S2**2 * ratio**2 / omega**3
