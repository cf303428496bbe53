"""How often controllers and untrained networks reach the goals of a task."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torchrl.envs.utils import ExplorationType

from gdrl_tasks import Outcome, Stream, episode_seeds
from gdrl_tasks.controllers import Pilot, Planner
from gdrl_tasks.engines.batch import BatchSimulation
from gdrl_torchrl import keys
from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.runs.checkpoint import seed_everything

CONTROLLERS = {"indoor": Planner, "water": Pilot}
MODES = {
    "greedy": ExplorationType.DETERMINISTIC,
    "sampled": ExplorationType.RANDOM,
}


_MEASURED: dict[tuple[str, str, int, bytes], np.ndarray] = {}
"""Success by task, mode, episodes and weights."""


def controller_seeds(episodes: int) -> np.ndarray:
    """Seeds of the worlds that controllers are measured on, int64 ``[N]``."""
    return episode_seeds(Stream.CONTROLLER, 0, 0, episodes)


def scripted(overrides: list[str], episodes: int, *, num_threads: int = 0) -> float:
    """Share of episodes in which the controller that knows the world reaches the goal.

    Args:
        overrides: The preset, as on the command line.
        episodes: How many.
        num_threads: Threads of the simulation; 0 takes one per allowed processor.
    """
    task = make_task_of(load_experiment(overrides))
    worlds = BatchSimulation(task, episodes, num_threads=num_threads, seed=0)
    try:
        worlds.reset(seeds=controller_seeds(episodes))
        controller = CONTROLLERS[task.name](task, worlds.arrays)
        running = np.arange(episodes)
        while len(running):
            action = controller(running, worlds.qpos[running])
            result = worlds.step(action, running)
            running = running[result.outcome == Outcome.RUNNING]
        return float(np.mean(worlds.arrays["outcome"] == Outcome.SUCCESS))
    finally:
        worlds.close()


def untrained(
    overrides: list[str],
    mode: str,
    episodes: int,
    *,
    seeds: range = range(10),
    num_threads: int = 0,
) -> np.ndarray:
    """Share of episodes that networks with initial weights succeed in, ``[networks]``.

    Networks of Rainbow choose alike in both modes: what is random in its training is no
    part of the network. What was measured before, as for a regime, is not measured again.

    Args:
        overrides: The preset, as on the command line.
        mode: ``greedy`` or ``sampled``.
        episodes: Episodes of each network, the same for all.
        seeds: A run's seed for each network.
        num_threads: Threads of the simulation; 0 takes one per allowed processor.
    """
    config = load_experiment(overrides)
    task = make_task_of(config)
    actors = []
    for seed in seeds:
        seed_everything(seed)
        actors.append(make_actor(task, config.network, config.algorithm))
    exploration = getattr(config.algorithm, "exploration", "")
    mode = "greedy" if exploration == "epsilon_greedy" else mode
    genomes: Any = torch.stack([genome_of(actor) for actor in actors])
    weights = torch.cat([w.flatten() for w in genomes.values(True, True)])
    key = (repr(config.task), mode, episodes, weights.numpy().tobytes())
    if key in _MEASURED:
        return _MEASURED[key]
    evaluator = PopulationEvaluator(
        actors[0],
        num_episodes=episodes,
        create_env_fn=lambda: make_env(task, episodes, num_threads=num_threads, seed=0),
        exploration_type=MODES[mode],
    )
    try:
        seeds_of_worlds = torch.from_numpy(controller_seeds(episodes))
        result: Any = evaluator.evaluate(genomes, seeds=seeds_of_worlds)
    finally:
        evaluator.close()
    _MEASURED[key] = result[keys.SUCCESSES].double().mean(dim=1).numpy()
    return _MEASURED[key]
