"""What the commands have in common: their parser, and the pages of ``--help``."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import NoReturn

_WIDTH = 96
_COLUMN = 34


class CommandParser(argparse.ArgumentParser):
    """A parser of ``name=value`` arguments whose errors are one line.

    Args:
        prog: Name of the command.
        usage: What follows the name.
        description: What the command does.
        sections: Titles, and names with what they mean, for the page of ``--help``.
        examples: Commands.

    Examples:
        >>> parser = CommandParser("gdrl-x", "[seed=N]", "Does it.", [], ["gdrl-x seed=1"])
        >>> parser.parse_args(["seed=1"]).arguments
        ['seed=1']
    """

    def __init__(
        self,
        prog: str,
        usage: str,
        description: str,
        sections: Iterable[tuple[str, Iterable[tuple[str, str]]]],
        examples: Sequence[str],
    ) -> None:
        pages = [f"{title}:\n{table(rows)}" for title, rows in sections]
        shown = "\n".join(f"  {example}" for example in examples)
        super().__init__(
            prog=prog,
            usage=f"{prog} [-h] {usage}",
            description=textwrap.fill(description, _WIDTH),
            epilog="\n\n".join([*pages, f"examples:\n{shown}"]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            add_help=False,
        )
        self.switches = self.add_argument_group("switches")
        self.switches.add_argument("-h", "--help", action="help", help="Print this page.")
        self.add_argument("arguments", nargs="*", help=argparse.SUPPRESS)

    def error(self, message: str) -> NoReturn:
        """End the command with one line."""
        self.exit(1, f"error: {message}: see {self.prog} --help\n")


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and what they mean, in two columns.

    Examples:
        >>> print(table([("seed=0", "Seed of the run.")]))
          seed=0                          Seed of the run.
    """
    lines = []
    for name, meaning in rows:
        left = f"  {name}".ljust(_COLUMN)
        if not left.endswith(" "):
            lines.append(left)
            left = " " * _COLUMN
        indent = " " * _COLUMN
        lines.append(
            textwrap.fill(
                meaning or "-",
                _WIDTH,
                initial_indent=left,
                subsequent_indent=indent,
                break_on_hyphens=False,
            )
        )
    return "\n".join(lines)


def printable(text: str) -> str:
    r"""A text without what a terminal would obey or could not write.

    Examples:
        >>> printable("runs/\x1b[31mred")
        'runs/\\x1b[31mred'
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def one_line(error: object) -> str:
    """The text of an error as one line that can be printed."""
    return printable(" ".join(str(error).split()))


def fail(error: object) -> NoReturn:
    """End a command with an error."""
    sys.exit(f"error: {one_line(error)}")
