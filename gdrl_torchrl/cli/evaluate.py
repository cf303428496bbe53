"""``gdrl-evaluate run=<dir> episodes=N task.sea=rough ...``: evaluate a run again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from gdrl_torchrl.cli.shared.arguments import CommandParser, fail
from gdrl_torchrl.cli.shared.compose import merge_task
from gdrl_torchrl.cli.shared.saved_config import READ, config_of, named
from gdrl_torchrl.config.options import nearest, wrong_type
from gdrl_torchrl.config.schema import EvaluationConfig
from gdrl_torchrl.config.task import check_fits_policy, make_task_from_config
from gdrl_torchrl.files.fields import read_object

_OPTIONS = [
    ("run=<run directory>", "The run whose final policy is evaluated."),
    ("episodes=<number>", "Held-out episodes; those of the run's evaluation if not given."),
    ("seed=<number>", "Seed of the held-out worlds; the run's if not given."),
    ("task.<option>=<value>", "Other worlds: gdrl-train --help task=<name> lists options."),
]
_PARSER = CommandParser(
    "gdrl-evaluate",
    "run=<run directory> [<option>=<value> ...]",
    "Evaluate the final policy of a run on held-out worlds; prints one line of JSON. "
    "Nothing is written.",
    [("options", _OPTIONS)],
    [
        "gdrl-evaluate run=runs/gppo_water/1a2b3c4d/seed_0 episodes=1000",
        "gdrl-evaluate run=runs/gppo_water/1a2b3c4d/seed_0 task.sea=rough",
    ],
)


def evaluate_run(arguments: list[str]) -> dict[str, Any]:
    """Evaluate the final policy of a run on held-out worlds, perhaps other ones.

    Args:
        arguments: As on the command line.

    Returns:
        The evaluation, with the overrides.

    Raises:
        ValueError: If an argument is unknown or not valid, or a file of the run is
            missing or damaged.
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
            raise ValueError(_unknown(argument))
    if "run" not in values:
        raise ValueError("run=<run directory> must be given: see gdrl-evaluate --help")
    run = Path(values["run"])
    path = run / "config.json"
    if not path.exists():
        raise ValueError(f"run={run} must be a run directory: it has no config.json")
    saved = read_object(path, READ)
    with named(path):
        config = config_of(saved)
    numbers = {
        name: _whole_number(name, values[name])
        for name in ("episodes", "seed")
        if name in values
    }
    evaluation = dataclasses.replace(config.evaluation, **numbers)
    with named(path):
        trained = make_task_from_config(config.task)
    task_config = merge_task(saved["task"], overrides)
    task = make_task_from_config(task_config)
    check_fits_policy(trained, task, f"task.{' task.'.join(overrides)}")
    # torch takes seconds to import: what is wrong is said before.
    from gdrl_torchrl.agents.registry import make_actor
    from gdrl_torchrl.files.policy import load_policy, params_sha256
    from gdrl_torchrl.runs.evaluate import evaluate_policy

    with named(path):
        actor = make_actor(task, config.network, config.algorithm)
    load_policy(run / "final", actor, network=f"the network of {path}")
    scores = evaluate_policy(task, actor, evaluation, backend=task_config.backend)
    return {
        "task": task.name,
        "run": str(run),
        "overrides": [f"task.{override}" for override in overrides],
        **dataclasses.asdict(evaluation),
        **scores,
        "params_sha256": params_sha256(actor),
    }


def _unknown(argument: str) -> str:
    name, equals, _ = argument.partition("=")
    near = nearest(name, ("run", "episodes", "seed"))
    if not equals and Path(argument).is_dir():
        return f"{argument} must be given as run={argument}"
    hint = f"did you mean {near}=...?" if near else "see gdrl-evaluate --help"
    return f"{argument} must be an option that exists: {hint}"


def _whole_number(name: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError(
            wrong_type(f"{name}={text}", f"evaluation.{name}", EvaluationConfig)
        ) from None


def main() -> None:
    """Entry point of ``gdrl-evaluate``."""
    arguments = _PARSER.parse_args().arguments
    try:
        result = evaluate_run(arguments)
    except ValueError as error:
        fail(error)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
