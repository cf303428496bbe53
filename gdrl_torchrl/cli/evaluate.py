"""``gdrl-evaluate run=<dir> episodes=N task.sea=rough ...``: evaluate a run again."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from gdrl_torchrl.cli.compose import merge_task
from gdrl_torchrl.config.algorithms import algorithm_configs
from gdrl_torchrl.config.schema import EvaluationConfig, ExperimentConfig, NetworkConfig

_USAGE = (
    "usage: gdrl-evaluate run=<run directory> [episodes=N] [seed=N] "
    "[task.<option>=<value> ...]"
)


def evaluate_run(arguments: list[str]) -> dict[str, Any]:
    """Evaluate the final policy of a run on held-out worlds, perhaps other ones.

    Args:
        arguments: As on the command line.

    Returns:
        The evaluation, with the overrides.

    Raises:
        ValueError: If an argument is unknown or not valid, or the run has no policy.
    """
    values: dict[str, str] = {}
    overrides: list[str] = []
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name.startswith("task.") and equals:
            overrides.append(argument.removeprefix("task."))
        elif name in ("run", "episodes", "seed") and equals:
            values[name] = value
        else:
            raise ValueError(f"unknown argument {argument!r}\n{_USAGE}")
    if "run" not in values:
        raise ValueError(_USAGE)
    run = Path(values["run"])
    if not (run / "config.json").exists():
        raise ValueError(f"run={run} is not a run directory: it has no config.json")
    try:
        saved = json.loads((run / "config.json").read_text())
    except ValueError as error:
        raise ValueError(f"{run / 'config.json'} is not valid JSON: {error}") from error
    settings = saved["evaluation"] | {
        name: _whole_number(name, values[name])
        for name in ("episodes", "seed")
        if name in values
    }
    evaluation = EvaluationConfig(**settings)
    # torch takes seconds to import: arguments are checked before.
    from gdrl_torchrl.config.task import make_task_from_config
    from gdrl_torchrl.training.build import make_actor
    from gdrl_torchrl.training.evaluate import evaluate_policy, load_policy, params_sha256

    config = ExperimentConfig(
        task=merge_task(saved["task"], []),
        algorithm=algorithm_configs()[saved["algorithm"]["name"]](**saved["algorithm"]),
        network=NetworkConfig(**saved["network"]),
    )
    task_config = merge_task(saved["task"], overrides)
    task = make_task_from_config(task_config)
    trained = make_task_from_config(config.task).spec
    for name in ("observation", "action_size", "is_discrete"):
        if getattr(task.spec, name) != getattr(trained, name):
            raise ValueError(
                f"task.{' task.'.join(overrides)}: the policy was trained with "
                f"{name}={getattr(trained, name)}, not {getattr(task.spec, name)}"
            )
    actor = make_actor(task, config)
    load_policy(run / "final", actor)
    scores = evaluate_policy(task, actor, evaluation, backend=task_config.backend)
    return {
        "task": task.name,
        "run": str(run),
        "overrides": [f"task.{override}" for override in overrides],
        **dataclasses.asdict(evaluation),
        **scores,
        "params_sha256": params_sha256(actor),
    }


def _whole_number(name: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{name}={text!r} must be a whole number") from None


def main() -> None:
    """Entry point of ``gdrl-evaluate``."""
    try:
        result = evaluate_run(sys.argv[1:])
    except ValueError as error:
        sys.exit(f"error: {error}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
