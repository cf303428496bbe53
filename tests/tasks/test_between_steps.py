"""Contacts and goals are looked for once in a control step: nothing is missed between."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks.indoor.options import LONGEST_STEP_M
from gdrl_tasks.indoor.robot import FOOTPRINT_M

MARGIN_M = 0.005


def ways(name, substeps, *, num_steps, num_worlds, draw, **options):
    """States after each substep of control steps, ``[T, S + 1, W, nq]``, and the worlds.

    Every substep is a control step of its own, whatever the outcome; an action holds
    for some of them, as it would in one long step.
    """
    substep_s = gdrl_tasks.make_task(name).spec.substep_s
    times = {"control_interval_s": substep_s, "step_limit": 10**6}
    worlds = gdrl_tasks.simulate(
        name, num_worlds=num_worlds, num_threads=1, seed=0, **times, **options
    )
    worlds.reset()
    generator = np.random.default_rng(1)
    steps = []
    for _ in range(num_steps):
        action, states = draw(generator, num_worlds), [worlds.qpos.copy()]
        for _ in range(substeps):
            worlds.arrays["outcome"][:] = 0
            worlds.step(action)
            states.append(worlds.qpos.copy())
        steps.append(states)
    return np.array(steps), worlds


def room(middle, places, shapes):
    """Gaps between footprints around ``[W, 2]`` and what is nearest, ``[W]``."""
    gaps = []
    for number, is_box in enumerate(shapes.is_box):
        at, half_size = places[:, number], shapes.half_size[number]
        offset = middle - at[:, :2]
        turned = offset * [1.0, 0.0]
        turned[:, 0] = at[:, 2] * offset[:, 0] + at[:, 3] * offset[:, 1]
        turned[:, 1] = at[:, 2] * offset[:, 1] - at[:, 3] * offset[:, 0]
        nearest = turned.clip(-half_size, half_size) if is_box else 0.0 * turned
        radius = 0.0 if is_box else half_size[0]
        gaps.append(np.linalg.norm(turned - nearest, axis=1) - radius)
    return np.min(gaps, axis=0) - FOOTPRINT_M


@pytest.mark.parametrize("arena", ["paper", "scatter"])
@pytest.mark.parametrize(("substeps", "missed_m"), [(6, 0.0), (36, MARGIN_M)])
@pytest.mark.parametrize("count", [60, pytest.param(150, marks=pytest.mark.full)])
def test_nobody_touches_an_obstacle_between_two_looks(
    arena, substeps, missed_m, count, indoor_pose
):
    """By default no contact is missed; at the longest step none but of the margin."""
    steps, worlds = ways(
        "indoor",
        substeps,
        num_steps=1440 // substeps,
        num_worlds=count,
        draw=lambda generator, count: generator.integers(5, size=count),
        arena=arena,
    )
    shapes, places = worlds.task.arena.shapes, worlds.arrays["obstacles"]
    collided = np.zeros(count, dtype=bool)
    for states in steps:
        gaps = np.array([room(indoor_pose(state)[0], places, shapes) for state in states])
        at_end = gaps[-1] <= MARGIN_M
        unseen = ~collided & ~at_end
        assert (gaps.min(axis=0)[unseen] > MARGIN_M - missed_m).all()
        collided |= at_end
    assert collided.sum() > count / 5


def test_the_longest_way_between_two_looks_is_the_radius_of_the_footprint():
    assert LONGEST_STEP_M == FOOTPRINT_M
    gdrl_tasks.make_task("indoor", control_interval_s=0.72)
    gdrl_tasks.make_task("indoor", control_interval_s=2.2, speed_m_s=0.05)
    with pytest.raises(
        ValueError, match=r"control_interval_s=0\.72 times speed_m_s=0\.3 .* 0\.11 m"
    ):
        gdrl_tasks.make_task("indoor", control_interval_s=0.72, speed_m_s=0.3)


@pytest.mark.parametrize(("substeps", "sideways_m"), [(8, 0.02), (32, 0.15)])
def test_the_way_of_a_vessel_in_a_control_step_is_nearly_straight(substeps, sideways_m):
    """Nearer to its chord than the goals of both difficulties are wide."""
    steps, _ = ways(
        "water",
        substeps,
        num_steps=640 // substeps,
        num_worlds=60,
        draw=lambda generator, count: np.sign(generator.normal(size=(count, 2))),
    )
    place = np.moveaxis(steps[..., :2], 1, 0)
    chord = place[-1] - place[0]
    length = np.linalg.norm(chord, axis=-1)
    offset = place - place[0]
    across = np.abs(chord[..., 0] * offset[..., 1] - chord[..., 1] * offset[..., 0])
    long = length > 0.05
    assert (across[:, long] / length[long]).max() < sideways_m
    assert long.mean() > 0.5
