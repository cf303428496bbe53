"""The MuJoCo model: a rigid body, and the parts that are only drawn."""

from __future__ import annotations

import mujoco

from gdrl_tasks.water.hull import GRAVITY_M_S2, Hull
from gdrl_tasks.water.surroundings import add_surroundings
from gdrl_tasks.water.vessel import add_vessel


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
    # No reset after divergence: the task must find the diverged state.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    add_surroundings(
        spec, farthest_goal_m=farthest_goal_m, goal_tolerance_m=goal_tolerance_m
    )
    body = spec.worldbody.add_body(
        name="hull",
        mass=hull.mass_kg,
        inertia=hull.inertia,
        # Both are needed, or the inertia would not be written to XML.
        ipos=[0.0, 0.0, 0.0],
        explicitinertial=True,
    )
    body.add_freejoint(name="hull")
    add_vessel(spec, body, hull)
    spec.compile()
    return spec.to_xml()
