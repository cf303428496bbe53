"""The policy of a run and its held-out worlds, for commands that show what it does."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gdrl_tasks import NavigationTask
from gdrl_torchrl.cli.shared.compose import merge_task
from gdrl_torchrl.cli.shared.saved_config import READ, config_of, named
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import make_task_from_config
from gdrl_torchrl.files.fields import read_object


@dataclasses.dataclass(frozen=True)
class SavedPolicy:
    """A run's policy; made without torch, which :meth:`load` imports.

    Attributes:
        run: The run directory.
        config: What it was trained with.
        task: Where it is shown.
    """

    run: Path
    config: ExperimentConfig
    task: NavigationTask

    @classmethod
    def of(cls, run: str, overrides: Sequence[str]) -> SavedPolicy:
        """Read a run directory.

        Args:
            run: The directory.
            overrides: Other options of the task, ``option=value``.

        Raises:
            ValueError: If it is none, a file in it is damaged, it is not done, or an
                option is not valid.
        """
        folder = Path(run)
        path = folder / "config.json"
        if not path.exists():
            raise ValueError(f"run={run} must be a run directory: it has no config.json")
        if not (folder / "final").exists():
            raise ValueError(f"run={run} must be done: it has no policy in final/ yet")
        saved = read_object(path, READ)
        with named(path):
            config = config_of(saved)
        task = make_task_from_config(merge_task(saved["task"], list(overrides)))
        return cls(folder, config, task)

    def load(self) -> Any:
        """What acts: actions ``[K, ...]`` for observations ``[K, D]``.

        Raises:
            ValueError: If the policy's file is missing or damaged, or the policy does
                not fit the task.
        """
        from gdrl_torchrl.agents.registry import make_actor
        from gdrl_torchrl.files.policy import load_policy
        from gdrl_torchrl.runs.evaluate import greedy_act

        path = self.run / "config.json"
        with named(path):
            actor = make_actor(self.task, self.config.network, self.config.algorithm)
        load_policy(self.run / "final", actor, network=f"the network of {path}")
        return greedy_act(actor)

    def seeds(self, episodes: int) -> np.ndarray:
        """Seeds of the first held-out episodes."""
        from gdrl_torchrl.runs.evaluate import held_out_seeds

        evaluation = dataclasses.replace(self.config.evaluation, episodes=episodes)
        return held_out_seeds(evaluation)
