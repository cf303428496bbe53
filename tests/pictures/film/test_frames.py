"""Frames of a film show the recorded states, at a whole multiple of real time."""

from __future__ import annotations

import numpy as np
import pytest

from gdrl_tasks import make_task
from gdrl_tasks.engines.scenery import draw_faster
from gdrl_torchrl.pictures.film import frames as frames_of
from gdrl_torchrl.pictures.film.episodes import record_trajectories
from tests.pictures.film.drivers import CONTROLLERS, drift

TASKS = ("water", "indoor")


def test_films_run_at_a_whole_multiple_of_real_time() -> None:
    short_task = make_task("water", step_limit=3)
    recorded = record_trajectories(short_task, drift(short_task), [0, 1], num_threads=1)
    recorded["steps"] = np.array([100, 31])

    def film(max_frames: int) -> frames_of.Film:
        return frames_of.Film.of(recorded, fps=25, height=2, width=2, max_frames=max_frames)

    # 32.75 s are 818.75 frames of a 25th of a second.
    real, faster = film(999), film(300)
    assert (real.speed, faster.speed) == (1, 3)
    moments = faster.moments(1)
    # Three 25ths of a second are 0.48 control steps of 0.25 s.
    np.testing.assert_allclose(moments[:-1], 0.48 * np.arange(len(moments) - 1))
    assert moments[-1] == 31.0
    assert 12.0 in moments
    assert real.num_frames == (625 + 1) + (194 + 1) + 2 * 25


@pytest.mark.render
@pytest.mark.parametrize(("name", "fps"), [("water", 4), ("indoor", 25)])
def test_frames_of_control_steps_show_the_recorded_episode(name: str, fps: int) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    task = make_task(name, step_limit=4)
    recorded = record_trajectories(task, CONTROLLERS[name], [5], num_threads=1)
    # As many frames as control steps: 4 a second, and 25 at three times real time.
    film = frames_of.Film(recorded, {4: 1, 25: 3}[fps], fps, 96, 128)
    frames = list(frames_of.rendered_frames(task, film))

    environment = make_environment(task)
    draw_faster(environment.physics)
    environment.task.next_episode_seed = 5
    environment.reset()
    try:
        for step, frame in enumerate(frames):
            behind = environment.physics.render(96, 128, camera_id="chase")
            difference = np.abs(frame[:, 128:].astype(int) - behind)
            assert difference.max() <= 3
            if step < 4:
                environment.step(recorded["action"][step, 0])
    finally:
        environment.close()
    assert len(frames) == 5
    assert (frames[0] != frames[-1]).any()


@pytest.mark.parametrize("name", TASKS)
def test_replay_for_a_film_has_the_recorded_states_bit_for_bit(name: str) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    task = make_task(name, step_limit=20)
    recorded = record_trajectories(task, CONTROLLERS[name], [5], num_threads=1)
    steps, actions = int(recorded["steps"][0]), recorded["action"][:, 0]
    noted, plain = make_environment(task), make_environment(task)
    for environment in (noted, plain):
        environment.task.next_episode_seed = 5

    replay = frames_of.replay_of(noted, actions)

    count = task.spec.num_substeps
    assert len(replay.qpos) == steps * count + 1
    position, heading = task.planar_pose(replay.qpos[::count])
    np.testing.assert_array_equal(position, recorded["position"][: steps + 1, 0])
    np.testing.assert_array_equal(heading, recorded["heading"][: steps + 1, 0])
    plain.reset()
    for step in range(steps):
        plain.step(actions[step])
        after = replay.qpos[(step + 1) * count]
        np.testing.assert_array_equal(after, plain.physics.data.qpos)
    np.testing.assert_array_equal(noted.physics.get_state(), plain.physics.get_state())


@pytest.mark.parametrize("name", TASKS)
def test_frames_between_substeps_lie_between_their_states(name: str) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    task = make_task(name, step_limit=6)
    recorded = record_trajectories(task, CONTROLLERS[name], [5], num_threads=1)
    played, shown = make_environment(task), make_environment(task)
    played.task.next_episode_seed = shown.task.next_episode_seed = 5
    replay = frames_of.replay_of(played, recorded["action"][:, 0])
    shown.reset()
    count = task.spec.num_substeps

    frames_of.pose(shown, replay, 2.25 / count)

    data = shown.physics.data
    before, after = replay.qpos[2], replay.qpos[3]
    np.testing.assert_allclose(
        data.qpos[:3], 0.75 * before[:3] + 0.25 * after[:3], atol=1e-12
    )
    assert np.linalg.norm(data.qpos[3:7]) == pytest.approx(1.0)
    assert data.time == pytest.approx(2.25 * task.spec.substep_s)
