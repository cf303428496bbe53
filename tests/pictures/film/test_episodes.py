"""Recorded episodes are those that were played."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gdrl_tasks import NavigationTask, Outcome, make_task
from gdrl_tasks.indoor.definition import clearance
from gdrl_torchrl.files.trajectories import read_trajectories, save_trajectories
from gdrl_torchrl.pictures.film.episodes import record_trajectories
from gdrl_torchrl.pictures.layout import posed
from tests.pictures.film.drivers import CONTROLLERS, SEEDS, drift, turn_to_goal

TASKS = ("water", "indoor")
COMMON = {
    "position",
    "heading",
    "action",
    "goal",
    "outcome",
    "steps",
    "episode_seed",
    "outcome_names",
    "tolerance",
    "control_interval_s",
}
SEA = {"sea_x", "sea_y", "sea_elevation"}
ARENA = {
    "obstacles",
    "obstacle_is_box",
    "obstacle_half_size",
    "half_extent",
    "vehicle_outline",
    "beam_angles",
}


def test_recorded_successes_end_at_their_goal(task: NavigationTask) -> None:
    act = CONTROLLERS[task.name]

    recorded = record_trajectories(task, act, range(6), num_threads=1)

    reached = np.flatnonzero(recorded["outcome"] == Outcome.SUCCESS)
    # Half of the goals indoors are behind a wall.
    assert len(reached) >= {"water": 5, "indoor": 3}[task.name]
    last = recorded["position"][recorded["steps"][reached], reached]
    # The swept segment passes the goal: its end may lie a step beyond the tolerance.
    distance = np.hypot(*(recorded["goal"][reached] - last).T)
    assert (
        distance < task.goal_tolerance_m + {"water": 0.5, "indoor": 0.02}[task.name]
    ).all()
    assert recorded["outcome_names"][recorded["outcome"][reached[0]]] == "success"


def test_rows_after_an_episode_are_blank(task: NavigationTask) -> None:
    act = CONTROLLERS[task.name]

    recorded = record_trajectories(task, act, range(6), num_threads=1, scans=True)

    longest = recorded["steps"].max()
    assert recorded["position"].shape == (longest + 1, 6, 2)
    assert recorded["action"].shape[:2] == (longest, 6)
    for k, steps in enumerate(recorded["steps"]):
        known = np.isfinite(recorded["position"][:, k]).all(axis=-1)
        np.testing.assert_array_equal(known, np.arange(longest + 1) <= steps)
        np.testing.assert_array_equal(known, np.isfinite(recorded["heading"][:, k]))
        if "scan" in recorded:
            seen = np.isfinite(recorded["scan"][:, k]).all(axis=-1)
            np.testing.assert_array_equal(known, seen)


def test_policy_sees_only_live_worlds_and_equal_seeds_give_equal_paths(
    task: NavigationTask,
) -> None:
    controller = CONTROLLERS[task.name]
    counts = []

    def act(observation: np.ndarray) -> np.ndarray:
        counts.append(len(observation))
        return controller(observation)

    together = record_trajectories(task, act, [3, 4, 5], num_threads=1)
    alone = record_trajectories(task, controller, [4], num_threads=1)

    assert counts[0] == 3
    assert sum(counts) == together["steps"].sum()
    steps = alone["steps"][0]
    np.testing.assert_array_equal(
        together["position"][: steps + 1, 1], alone["position"][:, 0]
    )


@pytest.mark.parametrize("name", TASKS)
def test_discrete_actions_are_recorded(name: str) -> None:
    task = make_task(name, actions="discrete", step_limit=2)

    recorded = record_trajectories(task, lambda o: np.full(len(o), 3), [0], num_threads=1)

    assert recorded["action"].tolist() == [[3], [3]]


@pytest.mark.parametrize(("name", "own"), [("water", SEA), ("indoor", ARENA)])
def test_only_what_a_task_has_is_recorded(name: str, own: set[str]) -> None:
    task = make_task(name, step_limit=1)

    recorded = record_trajectories(task, drift(task), SEEDS, num_threads=1)
    scanned = record_trajectories(task, drift(task), SEEDS, num_threads=1, scans=True)

    assert recorded.keys() == COMMON | own
    assert scanned.keys() - recorded.keys() == ({"scan"} if name == "indoor" else set())


@pytest.mark.parametrize("arena", ["paper", "scatter", "corridor", "trap"])
def test_recorded_obstacles_are_those_that_robots_hit(arena: str) -> None:
    task = make_task("indoor", arena=arena)

    recorded = record_trajectories(task, drift(task), range(8), num_threads=1)

    shapes = {"is_box": recorded["obstacle_is_box"]}
    shapes["half_size"] = recorded["obstacle_half_size"]
    for k in np.flatnonzero(recorded["outcome"] == Outcome.COLLISION):
        last = recorded["steps"][k]
        position, heading = recorded["position"][last, k], recorded["heading"][last, k]
        outline = posed(recorded["vehicle_outline"], position, heading)
        places = np.repeat(recorded["obstacles"][k, None], len(outline), axis=0)
        # A step is 18 mm, and what is 5 mm away counts as touched.
        nearest = clearance(outline, places, **shapes).min()
        assert -0.02 < nearest < 0.006
    assert (recorded["outcome"] == Outcome.COLLISION).sum() >= 5
    inside = np.abs(recorded["goal"]) < recorded["half_extent"]
    assert inside.all()


def test_recorded_scans_end_at_obstacles() -> None:
    task = make_task("indoor", arena="paper", step_limit=20)

    recorded = record_trajectories(task, turn_to_goal, [3], num_threads=1, scans=True)

    outline, angles = recorded["vehicle_outline"], recorded["beam_angles"]
    middle = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
    for step in (0, 7, 20):
        scan = recorded["scan"][step, 0]
        tips = middle + scan[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        tips = posed(tips, recorded["position"][step, 0], recorded["heading"][step, 0])
        places = np.repeat(recorded["obstacles"], len(tips), axis=0)
        distance = clearance(
            tips, places, recorded["obstacle_is_box"], recorded["obstacle_half_size"]
        )
        hits = scan < 3.5
        assert hits.sum() > 10
        np.testing.assert_allclose(distance[hits], 0.0, atol=1e-4)


def test_recorded_sea_is_that_of_the_first_episode() -> None:
    short_task = make_task("water", step_limit=3)
    recorded = record_trajectories(short_task, drift(short_task), SEEDS, num_threads=1)

    sea = short_task.draw_episode(SEEDS[0]).arrays
    x, y = recorded["sea_x"][7], recorded["sea_y"][300]
    phase = sea["wavenumber_x"] * x + sea["wavenumber_y"] * y + sea["phase"]
    expected = np.sum(sea["amplitude"] * np.cos(phase))
    assert recorded["sea_elevation"][300, 7] == pytest.approx(expected, abs=1e-6)


def test_trajectories_survive_the_file(tmp_path: Path, short_task: NavigationTask) -> None:
    recorded = record_trajectories(short_task, drift(short_task), SEEDS, num_threads=1)

    path = save_trajectories(tmp_path / "run", recorded)

    assert path == tmp_path / "run" / "trajectories.npz"
    read = read_trajectories(tmp_path / "run")
    assert read.keys() == recorded.keys()
    for name, value in recorded.items():
        np.testing.assert_array_equal(read[name], value)
