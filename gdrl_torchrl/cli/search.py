"""``gdrl-search +search=<name> ...``: look for good settings, with Optuna.

Started again it goes on; several processes may work at one search at a time.
"""

from __future__ import annotations

import importlib.util
import logging
import shlex
import sys

from gdrl_torchrl.cli.shared.arguments import CommandParser, fail
from gdrl_torchrl.cli.shared.compose import EXIT_SAVED, composed_part, load_experiment
from gdrl_torchrl.cli.shared.names import names_in, sentence_of
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.config.sentences import options_of

_DESCRIPTION = (
    "Look for good settings with Optuna: trials of settings, the best of which is printed "
    "last, as a command. Started again, it goes on; several may work at one search."
)
_EXAMPLES = (
    "gdrl-search +search=gppo_water",
    "gdrl-search +search=gppo_water search.num_trials=60 task.sea=rough",
)


def load_search(arguments: list[str]) -> SearchConfig:
    """Compose a search; overrides that are not its own become those of its runs.

    Raises:
        ValueError: If no search is named, or a value or an override is not valid.

    Examples:
        >>> search = load_search(["+search=ppo_water", "search.num_trials=3", "seed=1"])
        >>> search.num_trials, search.overrides
        (3, ['experiment=ppo_water', 'seed=1'])
    """
    named = [a for a in arguments if a.lstrip("+").startswith("search=")]
    names = [argument.partition("=")[2] for argument in named]
    if len(names) != 1:
        given = " ".join(named) or "+search=<name>"
        raise ValueError(f"{given} must be given once: see gdrl-search --help")
    others = [a for a in arguments if a not in named]
    own = [a for a in others if a.lstrip("+~").startswith("search.")]
    search = composed_part(SearchConfig, "search", "+search", names[0], own)
    search.overrides += [a for a in others if a not in own]
    return search


def _parser() -> CommandParser:
    searches = [(name, sentence_of("search", name)) for name in names_in("search")]
    rest = [
        ("<option>=<value>", "An option of all runs, which gdrl-train --help lists."),
    ]
    return CommandParser(
        "gdrl-search",
        "+search=<name> [search.<option>=<value> ...] [<option>=<value> ...]",
        _DESCRIPTION,
        [
            ("+search=<name>", searches),
            ("options", [*options_of(SearchConfig, "search"), *rest]),
        ],
        _EXAMPLES,
    )


def main() -> None:
    """Entry point of ``gdrl-search``."""
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    try:
        config = load_search(_parser().parse_args().arguments)
        # What is wrong is said before anything is loaded that takes long.
        make_task_of(load_experiment(config.overrides))
    except ValueError as error:
        fail(error)
    if importlib.util.find_spec("optuna") is None:
        fail("gdrl-search needs Optuna: pip install 'gdrl_torchrl[search]'")
    # Imported here so that a wrong argument is answered without them.
    from optuna.exceptions import OptunaError
    from sqlalchemy.exc import SQLAlchemyError

    from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
    from gdrl_torchrl.cli.trials.search import Search, search_table
    from gdrl_torchrl.cli.trials.study import error_of
    from gdrl_torchrl.files.errors import RunDirectoryError
    from gdrl_torchrl.runs.run import InterruptedRunError, run_experiment

    logging.getLogger("torchrl").setLevel(logging.WARNING)
    try:
        search = Search(config, run_experiment)
        search.optimize()
    except (
        *(OSError, MemoryError, RunDirectoryError, WorkerDiedError),
        *(OptunaError, SQLAlchemyError),
    ) as error:
        reason = str(error) or type(error).__name__
        fail(f"{reason}. The same command goes on with the trial that ran")
    except ValueError as error:
        fail(error)
    except InterruptedRunError as stop:
        print(stop, file=sys.stderr)
        sys.exit(EXIT_SAVED)
    print(search_table(search))
    best = search.best()
    if best is not None:
        overrides = [*config.overrides, *best.user_attrs["overrides"]]
        print(shlex.join(["gdrl-train", *overrides]))
    failed = [trial for trial in search.finished() if error_of(trial)]
    if failed:
        sys.exit(
            f"error: {len(failed)} trials failed, the last one: {error_of(failed[-1])}"
        )


if __name__ == "__main__":
    main()
