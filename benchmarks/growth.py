"""How population evaluation grows: with members, episodes and threads, in time and memory.

    python -m benchmarks.growth [--task water] [--members 11 64 ...]

Every cell is a process of its own: ``PopulationEvaluator`` over members x episodes
worlds with one thread and with two, and the raw engine with as many worlds and threads,
all by turns. Steps are those of live worlds, and resets are inside the time. Where a cell
would make more than ``--most-steps`` control steps, its episodes are cut by a shorter step
limit, which the table says: its resets weigh more then. Thread efficiency is the time
with one thread by twice the time with two. Memory is by how much the first evaluation
raises the largest resident memory; and, as no transitions are asked for, bytes for each
further step, from further evaluations with episodes cut at half the limit and whole,
should be next to nothing. For Linux with glibc. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import logging
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import torch

from benchmarks.collection import engine_alone
from benchmarks.common import finish, measure, ratio
from benchmarks.population_throughput import make_population
from gdrl_tasks import make_task
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.operators.genome import concatenate
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

THREADS = (1, 2)
MANY_WORLDS = 4096
"""With more of them one repeat must do."""
_FORGET_PEAK = "5"
"""Written to ``clear_refs``: the largest resident memory is the present one again."""


def resident_mb(name: str) -> float:
    """``VmRSS`` or its peak ``VmHWM`` of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(name))


class Cell:
    """One size of population on one task, at every number of threads."""

    def __init__(self, task: str, members: int, episodes: int, step_limit: int) -> None:
        self.members, self.episodes = members, episodes
        self.task = make_task(task, step_limit=step_limit)
        self.actor, population = make_population(task)
        copies = -(-members // len(population))
        self.population = concatenate([population] * copies)[:members]

    def evaluator(self, worlds: int, threads: int) -> PopulationEvaluator:
        """An evaluator with worlds and threads of its own."""
        env = NavigationEnv(self.task, worlds, num_threads=threads, seed=0)
        return PopulationEvaluator(
            self.actor, num_episodes=self.episodes, create_env_fn=lambda: env
        )

    def memory(self) -> dict[str, Any]:
        """What one evaluation adds to the memory of a process that has made a small one.

        Then, with every shape of batch met, what an evaluation takes while it runs, if
        its episodes are cut at half the limit, and if they are not.
        """
        self.evaluator(self.episodes, 1).evaluate(self.population[:1])
        worlds, limit = self.members * self.episodes, self.task.spec.step_limit
        evaluator = self.evaluator(worlds, 1)
        grown, _ = self._grown(evaluator, None)
        half, fewer_steps = self._grown(evaluator, limit // 2)
        whole, steps = self._grown(evaluator, None)
        return {
            "grown_mb": round(grown, 1),
            "kb_per_world": round(1024 * grown / worlds, 2),
            "running_mb": {fewer_steps: round(half, 2), steps: round(whole, 2)},
            "bytes_per_further_step": round(
                2**20 * (whole - half) / max(1, steps - fewer_steps), 1
            ),
        }

    def _grown(
        self, evaluator: PopulationEvaluator, max_steps: int | None
    ) -> tuple[float, int]:
        """By how much an evaluation raised the resident memory at most, and its steps."""
        evaluator.max_steps = max_steps
        # What was freed goes back, or it would hide what is taken next.
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        before = resident_mb("VmRSS")
        Path("/proc/self/clear_refs").write_text(_FORGET_PEAK)
        steps = int(evaluator.evaluate(self.population)["frames"].sum())
        return resident_mb("VmHWM") - before, steps

    def rates(self, repeats: int) -> dict[str, Any]:
        """Rates of evaluator and engine and what follows from them."""
        worlds, limit = self.members * self.episodes, self.task.spec.step_limit
        evaluators = [self.evaluator(worlds, threads) for threads in THREADS]

        def run(evaluator: PopulationEvaluator) -> int:
            return int(evaluator.evaluate(self.population)["frames"].sum())

        rates = measure(
            *(lambda own=own: run(own) for own in evaluators),
            *(engine_alone(self.task, worlds, limit, threads=n) for n in THREADS),
            repeats=repeats,
        )
        own, raw = rates[: len(THREADS)], rates[len(THREADS) :]
        found: dict[str, Any] = {}
        for threads, ours, its in zip(THREADS, own, raw, strict=True):
            rate = statistics.median(ours)
            found[f"{threads}_threads"] = {
                "control_steps_per_s": round(rate, 1),
                "microseconds_per_control_step": round(1e6 / rate, 2),
                "raw_engine_steps_per_s": round(statistics.median(its), 1),
                "ratio_to_raw_engine": ratio(ours, its),
            }
        found["thread_efficiency"] = round(ratio(own[1], own[0]) / 2, 3)
        found["raw_engine_thread_efficiency"] = round(ratio(raw[1], raw[0]) / 2, 3)
        return found


def run_cell(told: dict[str, Any]) -> None:
    """Measure one cell, alone in this process."""
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    repeats = told.pop("repeats")
    cell = Cell(**told)
    print(json.dumps(cell.memory() | cell.rates(repeats)))


def measure_size(
    options: argparse.Namespace, members: int, episodes: int
) -> dict[str, Any]:
    """A cell in a process of its own, whose memory is nobody else's."""
    worlds = members * episodes
    whole = make_task(options.task).spec.step_limit
    limit = max(2, min(whole, options.most_steps // worlds))
    told = {
        "task": options.task,
        "members": members,
        "episodes": episodes,
        "step_limit": limit,
        "repeats": 1 if worlds > MANY_WORLDS else options.repeats,
    }
    command = [sys.executable, "-m", "benchmarks.growth", "--cell", json.dumps(told)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    cut = {"step_limit": limit, "episodes_are_cut": limit < whole}
    return found | cut | {"repeats": told["repeats"]}


def show_size(name: str, cell: dict[str, Any]) -> None:
    """Print the rows of a cell."""
    for threads in THREADS:
        part = cell[f"{threads}_threads"]
        print(
            f"  {name:>10s} {threads:7d} {part['control_steps_per_s']:10,.0f} "
            f"{part['microseconds_per_control_step']:8.1f} "
            f"{part['ratio_to_raw_engine']:7.3f} {cell['thread_efficiency']:8.2f} "
            f"{cell['raw_engine_thread_efficiency']:8.2f} {cell['kb_per_world']:8.1f} "
            f"{cell['bytes_per_further_step']:8.1f} {cell['step_limit']:6d}"
            + (" (cut)" if cell["episodes_are_cut"] else ""),
            flush=True,
        )


def main() -> None:
    """Measure every size and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="indoor")
    parser.add_argument("--members", type=int, nargs="+", default=[11, 64, 256, 1024])
    parser.add_argument("--episodes", type=int, nargs="+", default=[10, 20])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--most-steps", type=int, default=500_000)
    parser.add_argument("--cell", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cell is not None:
        run_cell(options.cell)
        return
    print(f"{options.task}: control steps, efficiency of threads, memory")
    print(
        "     worlds threads    steps/s  us/step   ratio  effic.  (raw) KB/world "
        " B/step  limit"
    )
    results: dict[str, Any] = {}
    for members in options.members:
        for episodes in options.episodes:
            name = f"{members}x{episodes}"
            results[name] = measure_size(options, members, episodes)
            show_size(name, results[name])
    finish({options.task: results})


if __name__ == "__main__":
    main()
