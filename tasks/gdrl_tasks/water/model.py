"""The MuJoCo model: a rigid body, and everything that only the eye sees."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from gdrl_tasks.water.hull import GRAVITY_M_S2, Hull

SEA_GRID = 91
"""Rows and columns of the drawn sea surface."""
SEA_PIXELS = 512
"""Rows and columns of its painted colours."""
WATER_COLOUR = (0.12, 0.38, 0.52)
_SCENERY = {"contype": 0, "conaffinity": 0, "group": 1}


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
        (
            "goal_ring",
            mujoco.mjtGeom.mjGEOM_CYLINDER,
            [goal_tolerance_m, 0.08, 0],
            0.06,
            0.35,
        ),
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
