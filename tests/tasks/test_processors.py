"""Threads are as many as the processors that a process may use, not as the machine has."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gdrl_tasks
from gdrl_tasks.processors import allowed_processors, processor_quota

GROUP = Path("/sys/fs/cgroup/cpu")


def files(root, contents):
    for name, text in contents.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


@pytest.mark.parametrize(
    ("contents", "expected"),
    [
        ({}, float("inf")),
        ({"proc/self/cgroup": "no such line"}, float("inf")),
        (
            {"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "150000 100000\n"},
            1.5,
        ),
        (
            {"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "max 100000\n"},
            float("inf"),
        ),
        (  # the limit of a group above
            {
                "proc/self/cgroup": "0::/job/step\n",
                "sys/fs/cgroup/job/cpu.max": "400000 100000\n",
                "sys/fs/cgroup/job/step/cpu.max": "max 100000\n",
            },
            4.0,
        ),
        (  # a container that is told the path of its group on the host
            {
                "proc/self/cgroup": "0::/docker/abc\n",
                "sys/fs/cgroup/cpu.max": "200000 100000\n",
            },
            2.0,
        ),
        (
            {
                "proc/self/cgroup": "3:cpuset:/\n2:cpu,cpuacct:/job\n1:name=systemd:/\n",
                "sys/fs/cgroup/cpu/job/cpu.cfs_quota_us": "50000\n",
                "sys/fs/cgroup/cpu/job/cpu.cfs_period_us": "100000\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n",
            },
            0.5,
        ),
    ],
    ids=["none", "strange", "quota", "no limit", "above", "container", "first version"],
)
def test_the_quota_of_a_control_group_is_read(contents, expected, tmp_path):
    assert processor_quota(files(tmp_path, contents)) == expected


def threads_in_a_process(before):
    """Threads of a simulation in a process that does something before."""
    program = f"import os\n{before}\nimport gdrl_tasks\n"
    program += "print(gdrl_tasks.simulate('water', num_worlds=1).num_threads)"
    command = [sys.executable, "-c", program]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_a_simulation_has_a_thread_per_processor_of_the_affinity():
    one = min(os.sched_getaffinity(0))
    assert threads_in_a_process(f"os.sched_setaffinity(0, {{{one}}})") == 1
    assert gdrl_tasks.simulate("water", num_worlds=1).num_threads == allowed_processors()


def test_a_simulation_has_no_more_threads_than_the_quota_of_a_real_control_group():
    if allowed_processors() < 2:
        pytest.skip("there is one processor, of which no quota can take any")
    group = GROUP / f"gdrl_test_{os.getpid()}"
    try:
        group.mkdir()
        (group / "cpu.cfs_quota_us").write_text("90000")
    except OSError as error:
        pytest.skip(f"control groups cannot be made here, which needs privileges: {error}")
    try:
        join = f"open('{group}/cgroup.procs', 'w').write(str(os.getpid()))"
        assert threads_in_a_process(join) == 1
    finally:
        group.rmdir()
