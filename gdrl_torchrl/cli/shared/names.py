"""Files of ``conf/`` by group, ours and those of other packages; knows no Hydra."""

from __future__ import annotations

import functools
import itertools
from importlib import resources
from importlib.resources.abc import Traversable

from gdrl_torchrl.plugins import conf_packages

CONFIG_MODULE = "gdrl_torchrl.conf"


@functools.cache
def names_in(group: str) -> tuple[str, ...]:
    """Names of a group's files, in order; none if there is no such group.

    Examples:
        >>> names_in("algorithm")
        ('ga', 'ppo', 'ppo_sparse', 'rainbow')
    """
    return tuple(sorted(_files_in(group)))


def sentence_of(group: str, name: str) -> str:
    """What a file says of itself: its first comment.

    Examples:
        >>> sentence_of("sweep", "trials")
        'How many episodes should fitness be over? The papers: 10 to 20.'
    """
    lines = _files_in(group)[name].read_text().splitlines()
    lines = [line for line in lines if not line.startswith("# @")]
    comment = itertools.takewhile(lambda line: line.startswith("# "), lines)
    return " ".join(line.removeprefix("# ") for line in comment)


@functools.cache
def _files_in(group: str) -> dict[str, Traversable]:
    files = {}
    for package in (CONFIG_MODULE, *conf_packages()):
        folder = resources.files(package).joinpath(group)
        if group and folder.is_dir():
            for file in folder.iterdir():
                if file.name.endswith(".yaml"):
                    files.setdefault(file.name.removesuffix(".yaml"), file)
    return files
