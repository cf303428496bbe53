"""How many processors this process may use, of those that the machine has."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path


def allowed_processors() -> int:
    """Processors that this process may use at a time; at least 1.

    Those of its affinity, as ``taskset`` and job systems set it, but no more than the quota
    of its control group, as containers have one.

    Examples:
        >>> 1 <= allowed_processors() <= os.cpu_count()
        True
    """
    return math.ceil(min(len(os.sched_getaffinity(0)), processor_quota()))


def processor_quota(root: Path = Path("/")) -> float:
    """Processors that the control group of this process, or one above it, may use.

    Args:
        root: Where ``proc`` and ``sys`` are.

    Returns:
        A number that need not be whole; infinity if there is no limit or no such group.
    """
    quotas = [math.inf]
    # Whatever cannot be read says nothing of a limit.
    with contextlib.suppress(OSError, ValueError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            mounted = root / "sys/fs/cgroup"
            if controllers:
                mounted /= "cpu"
            if not controllers or "cpu" in controllers.split(","):
                group = mounted / path.lstrip("/")
                # In a container the mounted root is the group, whatever path is told.
                above = [p for p in group.parents if p.is_relative_to(mounted)]
                quotas += [_quota_of(folder) for folder in (group, *above)]
    return min(quotas)


def _quota_of(group: Path) -> float:
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        with contextlib.suppress(OSError, ValueError):
            words = [word for name in names for word in (group / name).read_text().split()]
            # ``max`` and -1 are no limit.
            if words[0] != "max" and int(words[0]) > 0:
                return int(words[0]) / int(words[1])
    return math.inf
