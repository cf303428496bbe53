"""Held-out evaluation of a policy, and where policies are kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_tasks import NavigationTask, Outcome, Stream, episode_seeds
from gdrl_tasks.definition import success_weighted_path_length
from gdrl_torchrl import keys
from gdrl_torchrl.config.schema import EvaluationConfig, ExperimentConfig
from gdrl_torchrl.envs.make import Backend, OnDivergence, make_env
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.private_copy import private_copy
from gdrl_torchrl.runs.kept_policies import KeptPolicies


def evaluate_policy(
    task: NavigationTask,
    actor: TensorDictModuleBase,
    config: EvaluationConfig,
    *,
    backend: Backend = "batch",
    num_threads: int = 0,
    on_divergence: OnDivergence = None,
) -> dict[str, float]:
    """Run the greedy policy on held-out worlds, and the policy that samples its actions.

    The two may differ by far: where a mean action falls into a dead zone, only noise moves.
    A policy that says of itself that it ``is_deterministic`` is run once.

    Args:
        task: The task.
        actor: The policy.
        config: Number of episodes, seed of the worlds, worlds at a time.
        backend: What steps the worlds.
        num_threads: Simulation threads.
        on_divergence: Called with every world that diverges.

    Returns:
        Rates of each outcome, SPL and means per episode, by the names that
        ``evaluation.json`` uses: of the greedy policy, but for ``success_rate_sampled``.
    """
    genome = stack_copies(genome_of(actor), 1)
    results = _held_out(
        *(task, actor, genome, config, backend, num_threads, on_divergence),
        extra_keys=(keys.PATH_LENGTH, keys.SHORTEST_PATH),
    )
    result, sampled = results[0].squeeze(0), results[1][keys.SUCCESSES]
    outcome = result[keys.OUTCOMES].numpy()
    path = result[keys.PATH_LENGTH].numpy().astype(np.float64)
    shortest = result[keys.SHORTEST_PATH].numpy().astype(np.float64)
    time_s = result[keys.STEPS].numpy() * task.spec.control_interval_s
    spl = success_weighted_path_length(outcome == Outcome.SUCCESS, shortest, path)

    def rate(which: Outcome) -> float:
        return float(np.mean(outcome == which))

    return {
        "episodes": config.episodes,
        "success_rate": rate(Outcome.SUCCESS),
        "success_rate_sampled": float(sampled.double().mean()),
        "collision_rate": rate(Outcome.COLLISION),
        "timeout_rate": rate(Outcome.TIMEOUT),
        "capsized_rate": rate(Outcome.CAPSIZED),
        "diverged_rate": rate(Outcome.DIVERGED),
        "spl": float(np.mean(spl)),
        "return_mean": float(result[keys.RETURN_MEAN]),
        "steps_mean": float(np.mean(result[keys.STEPS].numpy())),
        "time_s_mean": float(np.mean(time_s)),
        "speed_m_s_mean": float(path.sum() / time_s.sum()),
    }


def evaluate_kept(
    task: NavigationTask,
    actor: TensorDictModuleBase,
    kept: KeptPolicies,
    config: ExperimentConfig,
    *,
    on_divergence: OnDivergence = None,
) -> list[dict[str, float]]:
    """Run policies that a run has kept on the held-out worlds, in both modes.

    Nothing of it is fed back to the run, and its steps are in no count of costs.

    Returns:
        What each had cost, its number from 1, ``success_rate`` (greedy) and
        ``success_rate_sampled``.
    """
    # Marks that one step of training passed keep the same policy, which is run once.
    steps = torch.tensor([point["total_steps"] for point in kept.points])
    _, policy, marks = steps.unique_consecutive(return_inverse=True, return_counts=True)
    last = marks.cumsum(0) - 1
    results = _held_out(
        *(task, actor, kept.genomes()[last], config.evaluation, config.task.backend),
        *(config.simulation.num_threads, on_divergence),
    )
    greedy, sampled = (r[keys.SUCCESSES].double().mean(dim=-1)[policy] for r in results)
    rows = zip(kept.points, greedy.tolist(), sampled.tolist(), strict=True)
    return [
        {"point": i + 1, **point, "success_rate": rate, "success_rate_sampled": drawn}
        for i, (point, rate, drawn) in enumerate(rows)
    ]


def _held_out(
    task: NavigationTask,
    actor: TensorDictModuleBase,
    genomes: TensorDictBase,
    config: EvaluationConfig,
    backend: Backend,
    num_threads: int,
    on_divergence: OnDivergence,
    extra_keys: tuple[str, ...] = (),
) -> tuple[Any, Any]:
    """Scores ``[P]`` of policies that act greedily, and of those that sample."""
    worlds = min(config.num_worlds, config.episodes)
    evaluator = PopulationEvaluator(
        actor,
        num_episodes=config.episodes,
        create_env_fn=lambda: make_env(
            task,
            worlds,
            backend=backend,
            num_threads=num_threads,
            seed=0,  # of no episode: each is given its own
            on_divergence=on_divergence,
        ),
        extra_keys=extra_keys,
    )
    seeds = torch.from_numpy(held_out_seeds(config))
    try:
        greedy = evaluator.evaluate(genomes, seeds=seeds)
        if getattr(actor, "is_deterministic", False):
            return greedy, greedy
        evaluator.exploration_type = ExplorationType.RANDOM
        return greedy, evaluator.evaluate(genomes, seeds=seeds)
    finally:
        evaluator.close()


def held_out_seeds(config: EvaluationConfig) -> np.ndarray:
    """Seeds of the held-out worlds, a stream apart from training and fitness."""
    return episode_seeds(Stream.EVALUATION, config.seed, 0, config.episodes)


def greedy_act(actor: TensorDictModuleBase) -> Callable[[np.ndarray], np.ndarray]:
    """The greedy policy on NumPy observations: ``[K, D]`` to actions ``[K, ...]``.

    A copy acts, with the policy's weights, buffers and modes as they are now.
    """
    actor = private_copy(actor)

    @torch.no_grad()
    def act(observation: np.ndarray) -> np.ndarray:
        rows = torch.from_numpy(observation.astype(np.float32))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            out = actor(TensorDict({keys.OBSERVATION: rows}, batch_size=rows.shape[:1]))
        return out[keys.ACTION].numpy()

    return act


def evaluation_record(
    config: ExperimentConfig, scores: dict[str, Any], costs: dict[str, Any], digest: str
) -> dict[str, Any]:
    """The content of ``evaluation.json``, in its order."""
    return {
        "task": config.task.name,
        "algorithm": config.algorithm_label,
        "seed": config.seed,
        **scores,
        **costs,
        "params_sha256": digest,
    }
