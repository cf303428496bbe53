"""Arguments of the commands that show a run's policy; imports nothing that takes long."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

RUN = "run=<folder>"
_RUN_MEANS = "The run directory, as gdrl-train prints it. This one must be given."
_TASK = "task.<option>=<value>"
_TASK_MEANS = "Another option of the task than the run was trained with."


class Arguments(argparse.ArgumentParser):
    """``name=value`` arguments of a command that shows a run's policy.

    Args:
        command: Its name.
        does: What it does, in a sentence or two.
        options: What its own options mean, by ``name=<what>``.
        examples: Two command lines.
    """

    def __init__(
        self, command: str, does: str, options: Mapping[str, str], examples: Sequence[str]
    ) -> None:
        self.options = {RUN: _RUN_MEANS, **options, _TASK: _TASK_MEANS}
        self.names = [option.partition("=")[0] for option in (RUN, *options)]
        width = max(map(len, self.options)) + 2
        lines = [f"  {option:<{width}}{means}" for option, means in self.options.items()]
        super().__init__(
            command,
            usage=f"{command} {RUN} [<option>=<value> ...]",
            description=does,
            epilog="\n".join(["options:", *lines, "", "examples:", *examples]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.add_argument("arguments", nargs="*", help=argparse.SUPPRESS)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in a line; Python's parser adds its usage."""
        sys.exit(f"error: {message}; {self.prog} --help says what there is")

    def read(self, given: Sequence[str] | None = None) -> tuple[dict[str, str], list[str]]:
        """Values by name, and ``option=value`` of the task."""
        values: dict[str, str] = {}
        overrides: list[str] = []
        for argument in self.parse_args(given).arguments:
            name, equals, value = argument.partition("=")
            if equals and name.startswith("task."):
                overrides.append(argument.removeprefix("task."))
            elif equals and name in self.names:
                values[name] = value
            else:
                known = ", ".join(f"{name}=..." for name in (*self.names, "task.<option>"))
                self.error(f"{argument} must be one of {known}")
        if "run" not in values:
            self.error(f"{RUN} must be given")
        return values, overrides


def number_in(
    values: Mapping[str, str], name: str, usual: float, *, least: float, most: float
) -> Any:
    """A number that may be given; whole where the usual one is.

    Raises:
        ValueError: If it is none, or out of range.
    """
    text = values.get(name, str(usual))
    kind = type(usual)
    what = "whole number" if kind is int else "number"
    try:
        value = kind(text)
    except ValueError:
        value = None
    if value is None or not least <= value <= most:
        raise ValueError(f"{name}={text} must be a {what} from {least} to {most}")
    return value
