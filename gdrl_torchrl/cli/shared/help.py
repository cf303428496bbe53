"""The page of ``gdrl-train --help``; nothing is imported for it that takes long."""

from __future__ import annotations

from collections.abc import Sequence

from gdrl_tasks import task_names, task_options
from gdrl_torchrl.agents.registry import algorithm_configs
from gdrl_torchrl.cli.shared.arguments import CommandParser, fail
from gdrl_torchrl.cli.shared.names import names_in, sentence_of
from gdrl_torchrl.config import schema
from gdrl_torchrl.config.sentences import options_of
from gdrl_torchrl.evolution.settings import EVOLUTIONS, EvolutionConfig

_EXAMPLES = (
    "gdrl-train experiment=gppo_water seed=1 task.sea=rough budget.agent_steps=300_000",
    "gdrl-train -m +sweep=trials seed=0,1",
)

_MULTIRUN = "Run all combinations of values that are given as a,b or by a sweep."
_HYDRA = "List the other switches, which are Hydra's."


def help_of_training(arguments: Sequence[str]) -> str:
    """The page, or that of groups that are named beside ``--help``.

    Examples:
        >>> "algorithm.gamma=0.99" in help_of_training(["--help", "algorithm=ppo"])
        True
    """
    chosen = [a for a in arguments if not a.startswith("-")]
    groups = [group for argument in chosen for group in _group(argument)]
    sections = groups or [
        *_choices("experiment", "experiment=<name>: what is trained on what"),
        *_choices("task", "task=<name>"),
        *_choices("algorithm", "algorithm=<name>"),
        *_choices("evolution", "evolution=<name>: the population beside the agent"),
        *_choices("network", "network=<name>"),
        *_choices("regime", "+regime=<name>: settings under which learning is hard"),
        *_choices("tuned", "+tuned=<name>: what a search has found for an experiment"),
        *_choices("sweep", "-m +sweep=<name>: many runs that answer a question"),
        ("options, with what they are unless an experiment says otherwise", _common()),
        ("more options, by choice of a group", _more()),
    ]
    parser = CommandParser(
        "gdrl-train",
        "[-m] [experiment=<name>] [<option>=<value> ...]",
        "Train, or go on with a run that was begun; the last line printed is its folder.",
        sections,
        _EXAMPLES,
    )
    add = parser.switches.add_argument
    add(
        "-m",
        "--multirun",
        action="store_true",
        help=_MULTIRUN,
    )
    add("--cfg", metavar="job", help="Print the whole configuration and end.")
    add(
        "--hydra-help",
        action="store_true",
        help=_HYDRA,
    )
    return parser.format_help()


def _choices(group: str, title: str) -> list[tuple[str, list[tuple[str, str]]]]:
    return [(title, [(name, sentence_of(group, name)) for name in names_in(group)])]


def _common() -> list[tuple[str, str]]:
    return [
        *options_of(schema.ExperimentConfig, "")[:5],
        *options_of(schema.BudgetConfig, "budget"),
        *options_of(schema.EvaluationConfig, "evaluation"),
        *options_of(schema.CheckpointConfig, "checkpoint"),
        *options_of(schema.LoggerConfig, "logger"),
        *options_of(schema.SimulationConfig, "simulation"),
        *options_of(schema.FaultsConfig, "faults"),
        *options_of(schema.NetworkConfig, "network"),
    ]


def _more() -> list[tuple[str, str]]:
    return [
        (f"gdrl-train --help {group}=<name>", f"The options {group}.<option> of a choice.")
        for group in ("task", "algorithm", "evolution")
    ]


def _group(argument: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """The options of ``task=water``, ``algorithm=ppo`` or ``evolution=genetic``.

    Those of a preset, such as ``task=water_calm``, are the options of its task.
    """
    group, _, name = argument.partition("=")
    if group == "task" and name in names_in("task"):
        name = _task_of(name)
    if group == "task" and name in task_names():
        rows = [
            (
                "task.backend=batch",
                "What simulates: batch, or dm_control, which is slow.",
            ),
            *options_of(task_options(name), "task"),
        ]
    elif group == "algorithm" and name in algorithm_configs():
        rows = options_of(algorithm_configs()[name], "algorithm")
    elif group == "evolution" and name in names_in("evolution"):
        # The settings of most files are those of a population that is evaluated at times.
        rows = options_of(EVOLUTIONS.get(name, EvolutionConfig), "evolution")
    else:
        fail(
            f"--help {argument} must be task={'|'.join(task_names())}, "
            f"algorithm={'|'.join(algorithm_configs())} or "
            f"evolution={'|'.join(names_in('evolution'))}"
        )
    return [(f"options of {group}={name}", rows)]


def _task_of(preset: str) -> str:
    """The task that a file of ``conf/task`` is of: its name is what the file's begins with.

    Examples:
        >>> _task_of("water_calm"), _task_of("indoor")
        ('water', 'indoor')
    """
    tasks = [t for t in task_names() if f"{preset}_".startswith(f"{t}_")]
    return max(tasks, key=len, default=preset)
