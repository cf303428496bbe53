"""Held-out evaluation of a policy, and where policies are kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load, save
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_tasks import NavigationTask, Outcome, Stream, episode_seeds
from gdrl_tasks.navigation import success_weighted_path_length
from gdrl_torchrl import keys
from gdrl_torchrl.analysis.fields import DIGEST, read_object
from gdrl_torchrl.config.schema import EvaluationConfig, ExperimentConfig
from gdrl_torchrl.envs.make import Backend, OnDivergence, make_env
from gdrl_torchrl.evolution.genome import genome_of, stack_copies
from gdrl_torchrl.modules.private_copy import private_copy
from gdrl_torchrl.safe_files import own_folder, read_content, written_aside
from gdrl_torchrl.transforms.population_evaluator import PopulationEvaluator

POLICY_FILE = "policy.safetensors"
CONTRACT_FILE = "contract.json"


def evaluate_policy(
    task: NavigationTask,
    actor: TensorDictModuleBase,
    config: EvaluationConfig,
    *,
    backend: Backend = "batch",
    num_threads: int = 0,
    on_divergence: OnDivergence = None,
) -> dict[str, float]:
    """Run the greedy policy on held-out worlds.

    Args:
        task: The task.
        actor: The policy.
        config: Number of episodes, seed of the worlds, worlds at a time.
        backend: What steps the worlds.
        num_threads: Simulation threads.
        on_divergence: Called with every world that diverges.

    Returns:
        Rates of each outcome, SPL and means per episode, by the names that
        ``evaluation.json`` uses.
    """
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
        extra_keys=(keys.PATH_LENGTH, keys.SHORTEST_PATH),
    )
    try:
        seeds = held_out_seeds(config)
        result: Any = evaluator.evaluate(
            stack_copies(genome_of(actor), 1), seeds=torch.from_numpy(seeds)
        ).squeeze(0)
    finally:
        evaluator.close()
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


def params_sha256(module: nn.Module) -> str:
    """Digest of a module's parameters and buffers, by name."""
    return _digest(module.state_dict())


def _digest(state: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(state.items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def save_policy(
    folder: Path, actor: nn.Module, task: NavigationTask, config: ExperimentConfig
) -> None:
    """Write a policy's weights (safetensors) and what is needed to use them.

    A reader never sees half a file; until both are there, their digests differ.

    Raises:
        OSError: If a file cannot be written; what was there before is whole.
    """
    own_folder(folder)
    # Copies: the format refuses buffers that share memory, as TorchRL's supports do.
    state = {name: value.clone() for name, value in actor.state_dict().items()}
    # Not by ``save_file``, whose errors do not say what the system said.
    _write(folder / POLICY_FILE, save(state))
    low, high = task.spec.observation_bounds
    contract = {
        "task": task.name,
        "algorithm": config.algorithm_label,
        "observation": {name: spec[0] for name, spec in task.spec.observation.items()},
        "observation_low": low.tolist(),
        "observation_high": high.tolist(),
        "observation_dtype": "float32",
        "action_size": task.spec.action_size,
        "is_discrete": task.spec.is_discrete,
        "control_interval_s": task.spec.control_interval_s,
        "params_sha256": params_sha256(actor),
    }
    _write(folder / CONTRACT_FILE, f"{json.dumps(contract, indent=2)}\n".encode())


def load_policy(folder: Path, actor: nn.Module) -> None:
    """Read weights of :func:`save_policy` into an actor of the same shape.

    No code of the file is run: it has none. After an error the actor is what it was.

    Raises:
        ValueError: If the file is missing, damaged, of another network, holds numbers
            that are not finite, or is not what its contract, if there is one, says.
    """
    path, contract = folder / POLICY_FILE, folder / CONTRACT_FILE
    own = actor.state_dict()
    # The header takes some hundred bytes a tensor.
    most_bytes = 2**20 + 2 * sum(value.nbytes for value in own.values())
    try:
        state = load(read_content(path, most_bytes))
    # What a damaged file makes readers raise has no common type.
    except Exception as error:
        raise ValueError(f"{path} cannot be loaded: {error}") from error
    _check_state(state, own, path)
    if contract.exists():
        said = read_object(contract, {"params_sha256": DIGEST})["params_sha256"]
        if said != (found := _digest(state)):
            raise ValueError(
                f"{path} cannot be loaded: its params_sha256 is {found}, expected {said} "
                f"by {contract.name}"
            )
    actor.load_state_dict(state)


def _check_state(
    found: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor], path: Path
) -> None:
    """Raise ValueError unless two states have the same names, types and shapes."""
    problem = f"{path} cannot be loaded: it"
    if missing := sorted(expected.keys() - found.keys()):
        raise ValueError(f"{problem} has no {missing}")
    if unknown := sorted(found.keys() - expected.keys()):
        raise ValueError(f"{problem} has {unknown}, which the network has not")
    for name, its in found.items():
        own = expected[name]
        if (its.dtype, its.shape) != (own.dtype, own.shape):
            raise ValueError(
                f"{problem} has {name} of {its.dtype} {list(its.shape)}, the network has "
                f"{own.dtype} {list(own.shape)}"
            )
        if not bool(torch.isfinite(its).all()):
            raise ValueError(f"{problem} has {name} with numbers that are not finite")


def _write(path: Path, content: bytes) -> None:
    with written_aside(path) as aside:
        aside.write_bytes(content)


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
