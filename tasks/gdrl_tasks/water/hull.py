"""The hull: a Heron-sized twin-thruster catamaran, its coefficients and its model.

The horizontal dynamics are the identified Heron (Batista et al.; see the README of this
folder for every number and its source). What the identification lacks is computed here
from strip theory and naval-architecture formulas.
"""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np

WATER_DENSITY_KG_M3 = 1000.0
GRAVITY_M_S2 = 9.81
SEA_GRID = 181
"""Rows and columns of the drawn sea surface."""
SEA_PIXELS = 640
"""Rows and columns of its painted colours."""
WATER_COLOUR = (0.12, 0.38, 0.52)
_SCENERY = {"contype": 0, "conaffinity": 0, "group": 1}


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
    """Height of the centre of gravity over the keel."""
    yaw_inertia_total_kg_m2: float = 10.0
    """Rigid body and added inertia together."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Hull:
    """Constants of the equations of motion, derived by :func:`make_hull`.

    ``P`` is the number of hull points: ``stations`` along each of the two hulls. A
    point sits at the height of the centre of buoyancy of its section.
    """

    mass_kg: float
    draft_m: float
    depth_m: float
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


def make_hull(parameters: HullParameters | None = None) -> Hull:
    """Derive the constants of the equations of motion.

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
    radius = (0.4 * (p.hull_spacing_m + p.hull_beam_m), 0.25 * p.length_m)
    # Rounded to what a model in XML carries, so that both know the same rigid body.
    inertia = np.round(
        [
            p.mass_kg * radius[0] ** 2,
            p.mass_kg * radius[1] ** 2,
            p.yaw_inertia_total_kg_m2 - yaw_added,
        ],
        3,
    )
    # Heave, roll and pitch damping and added mass act at the hull points; their rigid
    # sums appear here because the equations of motion are solved for them implicitly.
    return Hull(
        mass_kg=p.mass_kg,
        draft_m=draft,
        depth_m=p.depth_m,
        spacing_m=spacing,
        inertia=inertia,
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


def _section_damping(omega: float, beam_m: float, draft_m: float) -> float:
    """Heave damping per metre of a wall-sided section, N s/m^2.

    Radiated energy: b = rho g^2 A^2 / w^3, with the ratio of the radiated wave to the
    heave amplitude A = 2 sin(k b / 2) exp(-k T) (Newman 1977, strip theory).
    """
    wavenumber = omega**2 / GRAVITY_M_S2
    ratio = 2.0 * math.sin(0.5 * wavenumber * beam_m) * math.exp(-wavenumber * draft_m)
    return WATER_DENSITY_KG_M3 * GRAVITY_M_S2**2 * ratio**2 / omega**3


def model_xml(
    hull: Hull, *, substep_s: float, farthest_goal_m: float, goal_tolerance_m: float
) -> str:
    """The MuJoCo model: a free hull, a marker for the goal and a visible sea.

    Forces of the water are not part of the model: the task applies them.

    Args:
        hull: Mass, inertia and dimensions.
        substep_s: Physics time step, seconds.
        farthest_goal_m: Farthest goal that the top camera must see, metres.
        goal_tolerance_m: Radius of the ring drawn around the goal, metres.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "water"
    spec.option.timestep = substep_s
    spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # A diverged world must stay diverged for the task to see it, not start afresh.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    _add_scenery(spec, farthest_goal_m, goal_tolerance_m)
    body = spec.worldbody.add_body(
        name="hull",
        mass=hull.mass_kg,
        inertia=hull.inertia,
        # Both are needed for the inertia to be written to XML.
        ipos=[0.0, 0.0, 0.0],
        explicitinertial=True,
    )
    body.add_freejoint(name="hull")
    _add_hull_shapes(body, hull)
    spec.compile()
    return spec.to_xml()


def _add_scenery(
    spec: mujoco.MjSpec, farthest_goal_m: float, goal_tolerance_m: float
) -> None:
    """Light, sky, sea, the goal's buoy and the camera over them."""
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.global_.offwidth = 1280
    spec.visual.global_.offheight = 960
    spec.stat.extent = farthest_goal_m
    spec.stat.center = [0.0, 0.0, 0.0]
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 40.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.55, 0.73, 0.88],
        rgb2=[0.93, 0.96, 0.98],
        width=64,
        height=384,
    )
    # The slopes of the waves are painted: facets of a height field would show.
    spec.add_texture(
        name="water",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=WATER_COLOUR,
        rgb2=WATER_COLOUR,
        width=SEA_PIXELS,
        height=SEA_PIXELS,
    )
    half_side = 1.8 * (farthest_goal_m + 1.0)
    # Two corners span the range of heights: the compiler stretches it to [0, 1].
    heights = np.full(SEA_GRID**2, 0.5)
    heights[0], heights[-1] = 0.0, 1.0
    spec.add_hfield(
        name="sea",
        nrow=SEA_GRID,
        ncol=SEA_GRID,
        size=[half_side, half_side, 1.0, 0.5],
        userdata=heights,
    )
    water = spec.add_material(name="water", specular=0.0, texuniform=False)
    water.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "water"
    spec.add_material(name="deep", rgba=[*WATER_COLOUR, 1.0], specular=0.0)
    world = spec.worldbody
    world.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0.0, 0.0, 20.0],
        dir=[0.2, 0.1, -1.0],
        diffuse=[0.55, 0.54, 0.5],
        specular=[0.3, 0.3, 0.3],
        castshadow=False,
    )
    world.add_geom(
        name="sea",
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="sea",
        material="water",
        pos=[0.0, 0.0, -0.5],
        **_SCENERY,
    )
    world.add_geom(
        name="horizon",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],
        material="deep",
        pos=[0.0, 0.0, -0.55],
        **_SCENERY,
    )
    fovy = 45.0
    height = (farthest_goal_m + 1.0) / math.tan(0.5 * math.radians(fovy))
    world.add_camera(
        name="top", pos=[0.0, 0.0, height], xyaxes=[1, 0, 0, 0, 1, 0], fovy=fovy
    )
    goal = world.add_body(name="goal", mocap=True)
    mark = 0.015 * farthest_goal_m
    shapes = (
        ("goal_buoy", mujoco.mjtGeom.mjGEOM_SPHERE, [0.16, 0, 0], 0.03, 1.0),
        ("goal_pole", mujoco.mjtGeom.mjGEOM_CYLINDER, [0.025, 0.45, 0], 0.45, 1.0),
        ("goal_mark", mujoco.mjtGeom.mjGEOM_SPHERE, [mark, 0, 0], 0.9 + mark, 1.0),
        ("goal_ring", mujoco.mjtGeom.mjGEOM_CYLINDER, [goal_tolerance_m, 0.08, 0], 0.06, 0.35),
    )
    for name, shape, size, at, opacity in shapes:
        goal.add_geom(
            name=name,
            type=shape,
            size=size,
            pos=[0.0, 0.0, at],
            rgba=[0.95, 0.3, 0.1, opacity],
            **_SCENERY,
        )


def _add_hull_shapes(body: mujoco.MjsBody, hull: Hull) -> None:
    """Two pontoons with pointed bows, a deck, a mast, and a camera behind them."""
    body.add_camera(
        name="chase",
        pos=[-3.0, 0.0, 1.9],
        xyaxes=[0.0, -1.0, 0.0, 0.43, 0.0, 0.9],
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
    )
    keel = hull.points[0, 2] - 0.5 * hull.draft_m
    radius = 0.112
    half_length = 0.5 * (hull.points[-1, 0] - hull.points[0, 0] + hull.spacing_m)
    stern, shoulder = -half_length + radius, half_length - 0.35
    middle = keel + radius
    yellow, dark = [0.95, 0.77, 0.1, 1.0], [0.18, 0.2, 0.23, 1.0]
    for side, sign in (("port", 1.0), ("starboard", -1.0)):
        across = sign * hull.lever_m
        body.add_geom(
            name=f"{side}_hull",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[stern, across, middle, shoulder, across, middle],
            size=[radius, 0.0, 0.0],
            rgba=yellow,
            mass=0.0,
            **_SCENERY,
        )
        body.add_geom(
            name=f"{side}_bow",
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            pos=[shoulder, across, middle],
            size=[half_length - shoulder, radius, radius],
            rgba=yellow,
            mass=0.0,
            **_SCENERY,
        )
        thruster = [-0.53, across, hull.thrust_height_m]
        body.add_site(name=f"{side}_thruster", pos=thruster)
        body.add_geom(
            name=f"{side}_pillar",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[-0.05, across, middle + 0.12],
            size=[0.2, 0.04, 0.05],
            rgba=dark,
            mass=0.0,
            **_SCENERY,
        )
    body.add_geom(
        name="deck",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.3, hull.lever_m + 0.05, 0.025],
        pos=[-0.05, 0.0, middle + 0.19],
        rgba=dark,
        mass=0.0,
        **_SCENERY,
    )
    body.add_geom(
        name="mast",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[0.018, 0.22, 0.0],
        pos=[-0.2, 0.0, middle + 0.43],
        rgba=[0.85, 0.87, 0.9, 1.0],
        mass=0.0,
        **_SCENERY,
    )
    body.add_geom(
        name="bow_mark",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.05, hull.lever_m - 0.1, 0.027],
        pos=[0.17, 0.0, middle + 0.19],
        rgba=[0.9, 0.92, 0.95, 1.0],
        mass=0.0,
        **_SCENERY,
    )
