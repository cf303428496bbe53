"""What a sweep tells of its jobs, wherever their processes were."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from gdrl_torchrl.checks import check_folder
from gdrl_torchrl.cli.shared.arguments import fail, one_line
from gdrl_torchrl.cli.shared.errors import check_known, check_known_to_hydra, explained

failed: list[str] = []
"""What is said of the jobs of this process's sweep that failed."""
_job: SweepReport | None = None


def note(**told: str) -> None:
    """Tell of a job of a sweep: its ``path``, that it was ``skipped``, or its ``error``."""
    if _job is None or os.getpid() == _job.process:
        _tell(told)
    else:
        _job.write(told)


def _tell(told: Mapping[str, str]) -> None:
    if "path" in told:
        print(told["path"], flush=True)
    for kind in told.keys() & {"skipped", "error"}:
        print(f"{kind}: {told[kind]}", file=sys.stderr, flush=True)
    if "error" in told:
        failed.append(told["error"])


class SweepReport(Callback):
    """Gathers what jobs tell that a launcher runs in other processes.

    Hydra makes one where a sweep is started, and launchers take a copy to each job.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse a sweep whose folder would be elsewhere, before that is made."""
        try:
            check_known(config)
            check_known_to_hydra(config.hydra)
            for name in _names_of(config):
                check_folder("name", name)
        except ValueError as error:
            # Hydra turns errors of callbacks into warnings.
            fail(error)
        self.process = os.getpid()
        sweep = Path(str(config.hydra.sweep.dir)).absolute()
        self.folder = sweep / ".jobs" / uuid.uuid4().hex

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember, in the job's process, where to tell."""
        global _job
        # A run that is no sweep has not started one.
        _job = self if hasattr(self, "folder") else None
        self.number = config.hydra.job.get("num")

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Tell what the jobs of other processes have told."""
        for file in sorted(self.folder.glob("*.json")):
            _tell(json.loads(file.read_text()))
        shutil.rmtree(self.folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            # Unless another sweep of this folder is going on.
            self.folder.parent.rmdir()

    def write(self, told: Mapping[str, str]) -> None:
        """Leave what a job tells for the process that started the sweep."""
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / f"{self.number:06d}.json"
        partial = file.with_suffix(".partial")
        partial.write_text(json.dumps(told))
        os.replace(partial, file)


def _names_of(config: DictConfig) -> list[str]:
    """The names that a sweep's runs will have: the configured one, and those of an axis."""
    given = list(config.hydra.overrides.task)
    with explained(given):
        overrides = OverridesParser.create().parse_overrides(given)
    names = [config.name]
    for override in overrides:
        if (
            override.get_key_element().lstrip("+") == "name"
            and override.is_sweep_override()
        ):
            names += [one_line(value) for value in override.sweep_string_iterator()]
    return names
