"""Models without the parts that are only drawn."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

LARGEST_PICTURE = (3840, 2160)
"""Width and height, pixels, of the largest picture that :func:`make_room` allows."""
USUAL_PICTURE = (1280, 960)
"""Width and height that models ask for; a larger buffer takes up to 400 MB more."""
PAINTED = "painted"
"""Prefix of the names of textures that a task paints for every picture, at any size."""
VISIBLE_ONLY = {"contype": 0, "conaffinity": 0, "group": 1, "mass": 0.0}
"""Group of geoms that touch nothing, weigh nothing and are not seen by a lidar."""

Colour = tuple[float, float, float]


def add_sky(spec: mujoco.MjSpec, zenith: Colour, nadir: Colour, *, width: int) -> None:
    """Add a sky and a haze of its colour at the horizon.

    Args:
        spec: The model.
        zenith: Red, green and blue straight above, 0 to 1.
        nadir: The same straight below.
        width: Columns of a face of the sky's cube, pixels.
    """
    # Any other colour at the horizon would give a stripe.
    spec.visual.rgba.haze = [*(0.5 * (np.array(zenith) + nadir)), 1.0]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=zenith,
        rgb2=nadir,
        width=width,
        height=6 * width,
    )


def without_scenery(xml: str) -> mujoco.MjModel:
    """Compile a model without cameras, lights, and parts that touch and weigh nothing.

    The engine would move these parts at every step, which takes 10 to 20 % of its time.
    The states that it computes are the same bit for bit. Geoms and bodies after the first
    one that is left out have other numbers than in the whole model.

    Args:
        xml: The whole model.

    Raises:
        ValueError: If a part that should only be drawn gives its body weight.

    Examples:
        >>> from gdrl_tasks import make_task
        >>> xml = make_task("water").xml()
        >>> mujoco.MjModel.from_xml_string(xml).ngeom, without_scenery(xml).ngeom
        (35, 0)
    """
    whole = mujoco.MjModel.from_xml_string(xml)
    spec = mujoco.MjSpec.from_string(xml)
    for seen in [*spec.cameras, *spec.lights, *spec.skins]:
        spec.delete(seen)
    for geom in list(spec.geoms):
        if not (geom.contype or geom.conaffinity):
            spec.delete(geom)
    model = spec.compile()
    # The weight of bodies that are moved by hand has no effect.
    moves = whole.body_mocapid < 0
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        before, after = getattr(whole, name), getattr(model, name)
        differs = moves & (before != after).reshape(whole.nbody, -1).any(axis=1)
        for number in differs.nonzero()[0]:
            raise ValueError(
                f"{name} of {whole.body(number).name!r} is {before[number]} with the "
                f"geoms that touch nothing and {after[number]} without: give them no mass"
            )
    for body in list(spec.bodies):
        if body.mocap and not body.bodies and not body.geoms:
            spec.delete(body)
    return spec.compile()


def draw_faster(physics: Any) -> None:
    """Let a physics that has not rendered yet draw coarsely, as for films.

    Edges are not smoothed, and shadows and painted surfaces have at most half of the
    pixels each way.
    """
    model = physics.model
    model.vis.quality.offsamples = 0
    model.vis.quality.shadowsize = min(1024, model.vis.quality.shadowsize)
    for texture in range(model.ntex):
        if model.id2name(texture, "texture").startswith(PAINTED):
            model.tex_width[texture] //= 2
            model.tex_height[texture] //= 2


def make_room(physics: Any, height: int, width: int) -> None:
    """Let a dm_control physics render pictures larger than its model asked for.

    Args:
        physics: The physics; it does not change beyond :data:`LARGEST_PICTURE`.
        height: Rows of the picture.
        width: Columns of the picture.
    """
    size = physics.model.vis.global_
    fits = width <= size.offwidth and height <= size.offheight
    if fits or width > LARGEST_PICTURE[0] or height > LARGEST_PICTURE[1]:
        return
    # Get the contexts before the size changes: new ones are made with the model's size.
    contexts = physics.contexts
    size.offwidth, size.offheight = max(width, size.offwidth), max(height, size.offheight)
    with contexts.gl.make_current() as context:
        context.call(
            mujoco.mjr_resizeOffscreen, size.offwidth, size.offheight, contexts.mujoco.ptr
        )


def cast_fewer_shadows(scene: mujoco.MjvScene) -> None:
    """Let skins and planes of a scene cast no shadow: water, floors, beams of a lidar.

    Nothing is below water and floor. The map of shadows is also too coarse for a surface
    that both casts shadows and is lit: such a surface gets specks. Geoms that MuJoCo
    takes for decoration are drawn but cast no shadow.
    """
    geom = mujoco.mjtGeom
    for seen in scene.geoms[: scene.ngeom]:
        if seen.type in (geom.mjGEOM_SKIN, geom.mjGEOM_PLANE):
            seen.category = mujoco.mjtCatBit.mjCAT_DECOR
