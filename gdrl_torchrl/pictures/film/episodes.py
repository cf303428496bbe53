"""Episodes of a policy, recorded for pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gdrl_tasks.definition import Outcome
from gdrl_tasks.engines.batch import BatchSimulation
from gdrl_tasks.indoor.lidar import beam_angles
from gdrl_tasks.indoor.robot import BODY_X_M, FOOTPRINT_M
from gdrl_tasks.indoor.task import IndoorTask
from gdrl_tasks.task import NavigationTask
from gdrl_torchrl.pictures.film.frames import (
    surface_of,
)

Act = Callable[[np.ndarray], np.ndarray]
"""Actions ``[K, A]`` or ``[K]`` for flat observations ``[K, D]`` of the live worlds."""


_SEA_SAMPLES = 400


_SEA_MARGIN_M = 2.0


_OUTLINE_CORNERS = 48


def record_trajectories(
    task: NavigationTask,
    act: Act,
    seeds: Sequence[int] | np.ndarray,
    *,
    num_threads: int = 0,
    scans: bool = False,
) -> dict[str, np.ndarray]:
    """Run one episode per seed and keep where the vehicles went.

    Args:
        task: The task.
        act: The policy. It is given the worlds whose episode goes on, in order.
        seeds: Episode seeds ``[K]``.
        num_threads: Threads of the simulation; 0 takes one per allowed processor.
        scans: Whether to keep what a lidar reported.

    Returns:
        Arrays by name; ``T`` is the longest episode's number of steps, rows after the
        end of an episode are NaN (zero in ``action``):

        - ``position`` (m) ``[T + 1, K, 2]``, ``heading`` (rad) ``[T + 1, K]``,
          ``action`` ``[T, K, A]`` or ``[T, K]``;
        - ``goal`` (m) ``[K, 2]``, ``outcome`` and ``steps`` ``[K]``, ``episode_seed``
          ``[K]``, ``outcome_names`` by outcome;
        - ``tolerance`` (m), ``control_interval_s``;
        - of a task with waves, the surface of the first episode as it begins:
          ``sea_x`` ``[N]``, ``sea_y`` ``[N]``, ``sea_elevation`` ``[N, N]`` (m);
        - of a task with walls and obstacles: their places ``obstacles`` ``[K, N, 4]``
          (x and y in m, cosine and sine of the yaw; the unused are 50 m away or more),
          ``obstacle_is_box`` ``[N]`` (others are cylinders), ``obstacle_half_size`` (m)
          ``[N, 2]``; half the arena's length and width inside the walls,
          ``half_extent`` (m) ``[2]``; and the vehicle in its own frame, ahead is +x,
          ``vehicle_outline`` (m) ``[P, 2]``;
        - of its lidar, in the outline's middle, ``beam_angles`` (rad from straight ahead)
          ``[B]`` and, with ``scans``, ``scan`` (m) ``[T + 1, K, B]``.

    Raises:
        ValueError: If there is no seed.
    """
    seeds = np.asarray(seeds, dtype=np.int64)
    if seeds.size == 0:
        raise ValueError("seeds=[] must name at least one episode")
    worlds = BatchSimulation(task, len(seeds), num_threads=num_threads)
    try:
        recorded = _run_episodes(worlds, act, seeds, scans=scans)
    finally:
        worlds.close()
    recorded |= {
        "goal": worlds.arrays["goal"].copy(),
        "outcome": worlds.arrays["outcome"].copy(),
        "steps": worlds.arrays["steps"].copy(),
        "episode_seed": seeds,
        "outcome_names": np.array([outcome.name.lower() for outcome in Outcome]),
        "tolerance": np.array(task.goal_tolerance_m),
        "control_interval_s": np.array(task.spec.control_interval_s),
    }
    if isinstance(task, IndoorTask):
        recorded |= _arena_of(task, worlds)
    surface = surface_of(task, int(seeds[0]))
    if surface is not None:
        places = np.concatenate([recorded["goal"], recorded["position"].reshape(-1, 2)])
        reach = float(np.nanmax(np.abs(places))) + _SEA_MARGIN_M
        reach = min(reach, 2.0 * np.abs(recorded["goal"]).max() + _SEA_MARGIN_M)
        side = np.linspace(-reach, reach, _SEA_SAMPLES)
        recorded |= {"sea_x": side, "sea_y": side}
        recorded["sea_elevation"] = surface(side, side, 0.0).astype(np.float32)
    return recorded


def _run_episodes(
    worlds: BatchSimulation, act: Act, seeds: np.ndarray, *, scans: bool
) -> dict[str, np.ndarray]:
    """Positions, headings, actions and scans of whole episodes, cut to the longest."""
    count, limit = len(seeds), worlds.task.spec.step_limit
    position = np.full((limit + 1, count, 2), np.nan)
    heading = np.full((limit + 1, count), np.nan)
    observation = worlds.reset(seeds=seeds)
    position[0], heading[0] = worlds.task.planar_pose(worlds.qpos)
    scan = None
    if scans and "scan" in worlds.arrays:
        seen = worlds.arrays["scan"]
        scan = np.full((limit + 1, *seen.shape), np.nan, dtype=np.float32)
        scan[0] = seen
    alive, actions = np.arange(count), []
    while len(alive):
        chosen = np.asarray(act(observation[alive]))
        action = np.zeros((count, *chosen.shape[1:]), chosen.dtype)
        action[alive] = chosen
        actions.append(action)
        result = worlds.step(chosen, alive)
        # The arrays keep the last position to be believed of a world that diverged.
        position[len(actions), alive] = worlds.arrays["position"][alive]
        heading[len(actions), alive] = worlds.task.planar_pose(worlds.qpos[alive])[1]
        if scan is not None:
            scan[len(actions), alive] = worlds.arrays["scan"][alive]
        observation[alive] = result.observation
        alive = alive[~(result.terminated | result.truncated)]
    steps = len(actions)
    recorded = {
        "position": position[: steps + 1],
        "heading": heading[: steps + 1],
        "action": np.stack(actions),
    }
    if scan is not None:
        recorded["scan"] = scan[: steps + 1]
    return recorded


def _arena_of(task: IndoorTask, worlds: BatchSimulation) -> dict[str, np.ndarray]:
    """What stands in the way of the robot, its outline, and where its lidar looks."""
    shapes = task.arena.shapes
    around = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_CORNERS, endpoint=False)
    circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
    options = task.options
    return {
        "obstacles": worlds.arrays["obstacles"].copy(),
        "obstacle_is_box": shapes.is_box,
        "obstacle_half_size": shapes.half_size,
        "half_extent": np.array(task.arena.half_extent_m),
        "vehicle_outline": FOOTPRINT_M * circle + [BODY_X_M, 0.0],
        "beam_angles": beam_angles(options.num_beams, options.field_of_view_deg),
    }
