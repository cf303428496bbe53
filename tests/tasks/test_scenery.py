"""What only the eye sees makes no difference to what happens."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from gdrl_tasks import make_task, task_names
from gdrl_tasks.batch import BatchSimulation
from gdrl_tasks.scenery import without_scenery

BOX = '<geom size="0.1" contype="{touches}" conaffinity="0" mass="{mass}"/>'
MODEL = """
<mujoco><worldbody><light/><camera/>
  <body name="box"><freejoint/>
    <geom name="solid" size="0.1" mass="1"/>
    {geom}
  </body>
  <body name="mark" mocap="true"><geom size="0.2" contype="0" conaffinity="0"/></body>
  <body name="door" mocap="true"><geom size="0.2"/></body>
  <body><freejoint/><geom size="0.3"/></body>
</worldbody></mujoco>
"""


class _Whole:
    """A task whose batches step the whole model."""

    def __init__(self, task):
        self._task = task

    def __getattr__(self, name):
        return getattr(self._task, name)

    def engine_model(self):
        return mujoco.MjModel.from_xml_string(self.xml())


@pytest.mark.parametrize("name", task_names())
def test_states_and_rewards_are_those_of_the_whole_model(name):
    task = make_task(name)
    worlds = [BatchSimulation(t, 6, num_threads=1, seed=0) for t in (task, _Whole(task))]
    ours, whole = worlds
    generator = np.random.default_rng(0)
    assert np.array_equal(*(w.reset(seeds=np.arange(6)) for w in worlds))
    for _ in range(60):
        shape = (6,) if task.spec.is_discrete else (6, task.spec.action_size)
        action = generator.uniform(-1.0, 1.0, size=shape)
        if task.spec.is_discrete:
            action = generator.integers(task.spec.action_size, size=shape)
        alive = np.flatnonzero(ours.arrays["outcome"] == 0)
        if len(alive) == 0:
            break
        for one, other in zip(*(w.step(action[alive], alive) for w in worlds), strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(ours.qpos, whole.qpos)
        np.testing.assert_array_equal(ours.qvel, whole.qvel)
    assert ours.model.ngeom < whole.model.ngeom


@pytest.mark.parametrize("name", [n for n in task_names() if make_task(n).model_fields])
def test_walls_have_the_same_numbers_in_both_models(name):
    # One and the same task writes their places into either.
    task = make_task(name)
    engine, whole = task.engine_model(), mujoco.MjModel.from_xml_string(task.xml())
    names = [[m.geom(i).name for i in range(m.ngeom)] for m in (engine, whole)]
    walls = [[(i, n) for i, n in enumerate(x) if "obstacle" in n] for x in names]
    assert walls[0] == walls[1]
    assert walls[0]


def test_only_what_touches_and_weighs_nothing_is_left_out():
    model = without_scenery(MODEL.format(geom=BOX.format(touches=0, mass=0)))
    assert [model.geom(i).name for i in range(model.ngeom)] == ["solid", "", ""]
    assert [model.body(i).name for i in range(model.nbody)] == ["world", "box", "door", ""]
    assert (model.ncam, model.nlight) == (0, 0)
    model = without_scenery(MODEL.format(geom=BOX.format(touches=1, mass=1)))
    assert model.ngeom == 4
    with pytest.raises(ValueError, match="mass of 'box'"):
        without_scenery(MODEL.format(geom=BOX.format(touches=0, mass=1)))
