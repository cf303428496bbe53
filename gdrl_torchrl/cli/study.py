"""``gdrl-study study=<name>``: run a study; any number of processes may work at it.

Started again it goes on, on another machine too: what has results is not run again.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gdrl_torchrl.checks import check_range
from gdrl_torchrl.cli.shared.arguments import CommandParser, fail
from gdrl_torchrl.cli.shared.compose import EXIT_SAVED, composed_part, load_experiment
from gdrl_torchrl.cli.shared.names import names_in, sentence_of
from gdrl_torchrl.config.sentences import options_of
from gdrl_torchrl.config.study import StudyConfig

_DESCRIPTION = (
    "Run a study: methods, tasks and seeds at equal total steps, judged on held-out "
    "worlds. Started again, it goes on; any number of processes, on machines that share "
    "runs_dir and results, may work at one study. gdrl-report shows what came out."
)
_EXAMPLES = (
    "gdrl-study study=pilot workers=2",
    "gdrl-study study=pilot --status",
)
_OWN = [
    ("results=results", "Folder of results of all studies."),
    ("runs_dir=runs", "Folder of all runs."),
    ("workers=1", "Processes that are started, each on a processor of its own."),
    ("core=<number>", "Processor that this process keeps to; any, if none is given."),
]
_MOST_WORKERS = 1024


def load_study(arguments: Sequence[str]) -> tuple[StudyConfig, dict[str, str]]:
    """Compose a study; what is not of its protocol is given beside it.

    Raises:
        ValueError: If no study is named, or an argument or a value is not valid.

    Examples:
        >>> study, rest = load_study(["study=pilot", "study.seeds=[7]", "workers=2"])
        >>> study.name, study.seeds, rest["workers"]
        ('pilot', [7], '2')
    """
    rest = {"results": "results", "runs_dir": "runs", "workers": "1", "core": ""}
    names, own = [], []
    for argument in arguments:
        name, _, value = argument.lstrip("+").partition("=")
        if name == "study":
            names.append(value)
        elif name.startswith("study."):
            own.append(argument)
        elif name in rest:
            rest[name] = value
        else:
            known = ["study=<name>", "study.<option>=<value>", *(n for n, _ in _OWN)]
            raise ValueError(f"{argument} must be one of {', '.join(known)}")
    if len(names) != 1:
        raise ValueError("study=<name> must be given once: see gdrl-study --help")
    return composed_part(StudyConfig, "study", "study", names[0], own), rest


def _parser() -> CommandParser:
    studies = [(name, sentence_of("study", name)) for name in names_in("study")]
    parser = CommandParser(
        "gdrl-study",
        "study=<name> [<option>=<value> ...] [--status]",
        _DESCRIPTION,
        [
            ("study=<name>", studies),
            ("options", _OWN),
            ("protocol", options_of(StudyConfig, "study")),
        ],
        _EXAMPLES,
    )
    parser.switches.add_argument(
        "--status", action="store_true", help="Print what is done and what is left."
    )
    return parser


def main() -> None:
    """Entry point of ``gdrl-study``."""
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    # A switch may stand anywhere among the other arguments.
    parsed = _parser().parse_intermixed_args()
    try:
        config, rest = load_study(parsed.arguments)
        workers = _whole("workers", rest["workers"], 1, _MOST_WORKERS)
        if rest["core"]:
            _keep_to(_whole("core", rest["core"], 0, 2**16))
    except ValueError as error:
        fail(error)
    if workers > 1 and not parsed.status:
        sys.exit(_with_workers(parsed.arguments, workers))
    # Imported here so that a wrong argument is answered without them.
    from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
    from gdrl_torchrl.files.errors import RunDirectoryError
    from gdrl_torchrl.runs.run import InterruptedRunError, run_experiment
    from gdrl_torchrl.studies.study import Study

    logging.getLogger("torchrl").setLevel(logging.WARNING)
    try:
        common = [f"runs_dir={rest['runs_dir']}"]
        study = Study(config, Path(rest["results"]), load_experiment, common)
        if parsed.status:
            print(study.status())
            return
        elsewhere = study.work(run_experiment)
    except (OSError, MemoryError, RunDirectoryError, WorkerDiedError) as error:
        reason = str(error) or type(error).__name__
        fail(f"{reason}. The same command goes on with what is left")
    except ValueError as error:
        fail(error)
    except InterruptedRunError as stop:
        print(stop, file=sys.stderr)
        sys.exit(EXIT_SAVED)
    if elsewhere:
        print(f"{len(elsewhere)} runs go on in other processes", file=sys.stderr)
    print(study.results.folder)


def _with_workers(arguments: Sequence[str], count: int) -> int:
    """Start processes, each on a processor of its own, and wait; the worst exit code."""
    allowed = sorted(os.sched_getaffinity(0))
    command = [sys.executable, "-m", "gdrl_torchrl.cli.study", *arguments]
    given = [
        [*command, "workers=1", f"core={allowed[i % len(allowed)]}"] for i in range(count)
    ]
    # In groups of their own: a terminal's signals come to them from here, once.
    started = [subprocess.Popen(each, process_group=0) for each in given]

    def hand_on(number: int, frame: Any) -> None:
        for process in started:
            process.send_signal(number)

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, hand_on)
    return max(abs(process.wait()) for process in started)


def _keep_to(core: int) -> None:
    try:
        os.sched_setaffinity(0, {core})
    except OSError as error:
        allowed = sorted(os.sched_getaffinity(0))
        raise ValueError(f"core={core} must be one of {allowed}") from error


def _whole(name: str, text: str, least: int, most: int) -> int:
    if not text.isdecimal():
        raise ValueError(f"{name}={text} must be a whole number")
    check_range(name, int(text), least=least, most=most)
    return int(text)


if __name__ == "__main__":
    main()
