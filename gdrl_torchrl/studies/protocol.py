"""The protocol of a study, its digest, and the runs that it asks for."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import Any

from gdrl_torchrl.config.study import StudyConfig


@dataclasses.dataclass(frozen=True, order=True)
class Job:
    """One run of a study."""

    task: str
    method: str
    seed: int


def protocol_of(config: StudyConfig) -> dict[str, Any]:
    """Everything that a study fixes, as plain values."""
    fixed = dataclasses.asdict(config)
    for name in ("elsewhere", "baseline"):
        # Studies from before there was such a field keep their digests.
        if not fixed[name]:
            del fixed[name]
    return fixed


def protocol_sha256(protocol: dict[str, Any]) -> str:
    """Digest of a protocol; each of its results bears it.

    Examples:
        >>> protocol_sha256({"name": "pilot"})[:12]
        '35f39c75ca84'
    """
    text = json.dumps(protocol, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def jobs_of(config: StudyConfig) -> list[Job]:
    """All runs of a study, seed by seed, so that early results are of all methods."""
    arms = [(task, name) for name, m in config.methods.items() for task in m.tasks]
    return [Job(task, name, seed) for seed in config.seeds for task, name in sorted(arms)]


def overrides_of(config: StudyConfig, task: str, method: str) -> list[str]:
    """What makes a run one of a method on a task; its seed is still to be given."""
    return [
        *config.methods[method].overrides,
        *config.tasks[task],
        f"name={config.name}_{task}_{method}",
        "budget.agent_steps=null",
        "budget.wall_s=null",
        f"budget.total_steps={config.total_steps[task]}",
        f"evaluation.seed={config.evaluation_seed}",
        f"evaluation.episodes={config.episodes}",
        f"evaluation.num_policies={config.num_policies}",
        # Each run has one processor, so that their wall times can be compared.
        "simulation.num_threads=1",
        "logger.tensorboard=false",
        "logger.figures=false",
        "logger.video_episodes=0",
    ]
