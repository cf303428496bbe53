"""``gdrl-train experiment=<name> ...``: train or go on; prints the run directory."""

from __future__ import annotations

import logging
import sys

import hydra
from omegaconf import DictConfig

from gdrl_torchrl.cli.compose import CONFIG_MODULE, register_configs, to_experiment


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="config", version_base="1.3")
def _train(config: DictConfig) -> None:
    try:
        experiment = to_experiment(config)
    except ValueError as error:
        sys.exit(f"error: {error}")
    # Imported here so that --help is answered without them.
    from gdrl_torchrl.training.run import InterruptedRunError, run_experiment
    from gdrl_torchrl.training.run_directory import RunDirectoryError

    # TorchRL reports on standard output, which is ours. Only now: importing it sets a
    # level of its own.
    for name in ("torchrl", "absl", "OpenGL"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        print(run_experiment(experiment))
    except InterruptedRunError as stop:
        print(stop, file=sys.stderr)
        sys.exit(128 + stop.signal)
    except (ValueError, RunDirectoryError) as error:
        sys.exit(f"error: {error}")


def main() -> None:
    """Entry point of ``gdrl-train``."""
    register_configs()
    _train()


if __name__ == "__main__":
    main()
