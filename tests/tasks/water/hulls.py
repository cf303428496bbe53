"""Hulls in any state, and what the water does to them."""

import dataclasses

import numpy as np

from gdrl_tasks.water import definition, waves
from gdrl_tasks.water.hull import make_hull
from gdrl_tasks.water.options import WaterOptions
from gdrl_tasks.water.task import WaterTask

HULL = make_hull()
SUBSTEP_S = WaterOptions().substep_s
NUM_WORLDS = 48


@dataclasses.dataclass
class State:
    """Anything that a hull may meet: ``W`` worlds."""

    qpos: np.ndarray
    qvel: np.ndarray
    time: np.ndarray
    thrust: np.ndarray
    command: np.ndarray
    current: np.ndarray
    sea: dict


def random_state(seed, *, still_water=False, level=False):
    """Worlds in any attitude: afloat, flying, under water; half of them at time 0."""
    generator = np.random.default_rng(seed)
    count = NUM_WORLDS
    seas = [
        WaterTask(WaterOptions(sea=sea)).draw_episode(seed + i).arrays
        for i, sea in enumerate(np.resize(["lake", "rough", "calm"], count))
    ]
    sea = {name: np.stack([a[name] for a in seas]) for name in waves.SEA_FIELDS}
    if still_water:
        sea["amplitude"][:] = 0.0
    quaternion = generator.normal(size=(count, 4))
    if level:
        quaternion = np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * quaternion
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    position = generator.normal(size=(count, 3)) * [5.0, 5.0, 0.15]
    return State(
        qpos=np.concatenate([position, quaternion], axis=1),
        qvel=generator.normal(size=(count, 6)),
        time=np.where(np.arange(count) % 2, generator.uniform(0.0, 40.0, count), 0.0),
        thrust=generator.uniform(-4.5, 22.5, (count, 2)),
        command=generator.uniform(-1.0, 1.0, (count, 2)),
        current=np.zeros((count, 2)) if still_water else generator.normal(size=(count, 2)),
        sea=sea,
    )


def array_wrench(state, hull=HULL, *, substep_s=SUBSTEP_S, compensated=False):
    mean, end = definition.advance_thrust(
        hull, state.thrust, state.command, substep_s, compensated
    )
    wrench = definition.hull_wrench(
        hull, state.sea, state.current, mean, state.qpos, state.qvel, state.time, substep_s
    )
    return wrench, end
