"""``gdrl-replay <file> [task.<option>=<value> ...]``: look at a fault of a run again.

A world that diverged makes its last step once more, perhaps with other options of the
task; of an update that was not finite it is told where numbers are missing.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gdrl_torchrl.checks import check_choice
from gdrl_torchrl.cli.shared.arguments import CommandParser, fail
from gdrl_torchrl.cli.shared.compose import merge_task

_PARSER = CommandParser(
    "gdrl-replay",
    "<file of faults/> [task.<option>=<value> ...]",
    "Look at a fault of a run again: a world that diverged makes its last step once more; "
    "of an update that was not finite it is told where numbers are missing. Prints one "
    "line of JSON.",
    [
        (
            "options",
            [
                ("<file>", "A file of the folder faults/ of a run directory."),
                (
                    "task.<option>=<value>",
                    "Repeat the step with other options of the task, which gdrl-train "
                    "--help task=<name> lists.",
                ),
            ],
        )
    ],
    [
        "gdrl-replay runs/gppo_water/1a2b3c4d/seed_0/faults/update.safetensors",
        "gdrl-replay runs/gppo_water/1a2b3c4d/seed_0/faults/diverged_7_12.safetensors "
        "task.substep_s=0.01",
    ],
)


def replay(path: Path, overrides: list[str]) -> dict[str, Any]:
    """Look at a file of a run's ``faults`` folder.

    Args:
        path: The file.
        overrides: Options of the task, ``name=value``.

    Returns:
        What is found, as JSON can hold it.

    Raises:
        ValueError: If the file cannot be read or is not one of those, or an override is
            not valid.
    """
    # torch takes seconds to import: arguments are checked before.
    if not path.is_file():
        raise ValueError(f"{path} must be a file of the folder faults/ of a run")
    from gdrl_torchrl.files.state import read_state

    try:
        content = read_state(path)
        kind = content["kind"]
    except (OSError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is not a file about a fault: {error!r}") from error
    check_choice(f"{path}: kind", kind, _KINDS)
    try:
        found = _KINDS[kind](content, overrides)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}") from error
    return {"file": str(path), "kind": kind, **found}


def _replay_world(content: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    from gdrl_tasks import Outcome
    from gdrl_tasks.engines.replay import repeat_step
    from gdrl_torchrl.config.task import make_task_from_config

    task = make_task_from_config(merge_task(content["task"], overrides))
    before = content["before"]
    worlds = repeat_step(task, before, content["action"])
    outcome = Outcome(int(worlds.arrays["outcome"][0]))
    return {
        "task": task.name,
        "overrides": [f"task.{override}" for override in overrides],
        "episode_seed": int(before["episode_seed"][0]),
        "steps_before": int(before["steps"][0]),
        "action": content["action"].tolist(),
        "qpos_before": before["qpos"][0].tolist(),
        "qvel_before": before["qvel"][0].tolist(),
        "qpos_after": worlds.qpos[0].tolist(),
        "qvel_after": worlds.qvel[0].tolist(),
        "outcome": outcome.name.lower(),
        "diverges_again": outcome == Outcome.DIVERGED,
    }


def _replay_update(content: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    from gdrl_torchrl.files.faults import non_finite_entries

    if overrides:
        raise ValueError(f"task.{overrides[0]}: an update has no task to change")
    batch = content["batch"]
    return {
        "not_finite": content["not_finite"],
        "rows": len(next(iter(batch.values()))),
        "entries": {name: list(value.shape) for name, value in batch.items()},
        "numbers_not_finite": non_finite_entries(batch),
    }


_KINDS = {"diverged_world": _replay_world, "update": _replay_update}


def main() -> None:
    """Entry point of ``gdrl-replay``."""
    files, overrides = [], []
    for argument in _PARSER.parse_args().arguments:
        is_override = argument.startswith("task.") and "=" in argument
        (overrides if is_override else files).append(argument)
    if len(files) != 1:
        given = " ".join(files) or "nothing"
        fail(f"{given}: one file must be given: see gdrl-replay --help")
    try:
        found = replay(Path(files[0]), [o.removeprefix("task.") for o in overrides])
    except ValueError as error:
        fail(error)
    # NaN and Infinity as Python's json reads and writes them.
    print(json.dumps(found))


if __name__ == "__main__":
    main()
