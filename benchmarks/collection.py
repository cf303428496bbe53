"""Control steps per second of an agent's collection, against the raw engine.

    python -m benchmarks.collection

Each task's own experiment as a training run builds it, stepped through its collector
with the untrained, exploring policy in the loop, at the 16 worlds of the experiments and
at 64, with as many steps per world and batch. The raw engine takes turns with it: as many
worlds of the same model, at rest, one ``step(nstep=...)`` per control step, no forces, no
observation, no policy. The last line is a JSON object with a key per task.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import os
import statistics
from collections.abc import Callable, Iterator
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import mujoco
import torch
from mujoco.batch import Batch

from benchmarks.common import finish, measure, ratio, show
from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Agent
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.runs import build
from gdrl_torchrl.runs.checkpoint import seed_everything

EXPERIMENTS = {"indoor": "grainbow_indoor", "water": "gppo_water"}
BARS = {("indoor", 16): 0.25, ("indoor", 64): 0.5}
"""Least ratio to the raw engine, by task and number of worlds."""


def engine_alone(
    task: NavigationTask, worlds: int, steps: int, *, threads: int = 0
) -> Callable[[], int]:
    """A run of the raw engine over control steps, from a reset every step limit."""
    batch = Batch(mujoco.MjModel.from_xml_string(task.xml()), worlds, threads)

    def run() -> int:
        for step in range(steps):
            if step % task.spec.step_limit == 0:
                batch.reset()
            batch.step(nstep=task.spec.num_substeps)
        return worlds * steps

    return run


def make_agent(name: str, worlds: int, threads: int) -> tuple[Agent, NavigationTask, int]:
    """The agent of a task's experiment, its task, and the frames of its batches."""
    config = load_experiment(
        [f"experiment={EXPERIMENTS[name]}", f"simulation.num_threads={threads}"]
    )
    algorithm = config.algorithm
    frames = algorithm.frames_per_batch // algorithm.num_worlds * worlds
    changed = dataclasses.replace(algorithm, num_worlds=worlds, frames_per_batch=frames)
    if isinstance(changed, RainbowConfig):
        # What a batch costs, not what is left of it beside updates.
        changed = dataclasses.replace(changed, collect_ahead=False)
    config = dataclasses.replace(config, algorithm=changed)
    seed_everything(config.seed)
    task = make_task_of(config)
    return build.make_agent(task, config), task, frames


def collector_and_engine(
    name: str, worlds: int, options: argparse.Namespace
) -> list[list[float]]:
    """Rates of the collector and of the engine alone."""
    agent, task, frames = make_agent(name, worlds, options.threads)
    assert agent.collector is not None
    batches: Iterator[Any] = iter(agent.collector)
    count = -(-options.frames // frames)

    def collect() -> int:
        return sum(next(batches).numel() for _ in range(count))

    steps = count * frames // worlds
    engine = engine_alone(task, worlds, steps, threads=options.threads)
    rates = measure(collect, engine, repeats=options.repeats)
    agent.collector.shutdown()
    return rates


def main() -> None:
    """Measure both tasks and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--frames", type=int, default=8192, help="least of a turn")
    parser.add_argument("--worlds", type=int, nargs="+", default=[16, 64])
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    results: dict[str, Any] = {}
    for name in EXPERIMENTS:
        print(f"{name}: control steps per second")
        results[name] = {}
        for worlds in options.worlds:
            rates = collector_and_engine(name, worlds, options)
            own, raw = map(statistics.median, rates)
            show(f"collector, {worlds} worlds", own)
            show(f"raw engine, {worlds} worlds", raw)
            found = ratio(*rates)
            show("ratio", found, digits=3)
            cell = {
                "control_steps_per_s": round(own, 1),
                "microseconds_per_control_step": round(1e6 / own, 2),
                "raw_engine_steps_per_s": round(raw, 1),
                "ratio_to_raw_engine": found,
            }
            bar = BARS.get((name, worlds))
            if bar is not None:
                cell |= {"bar": bar, "reaches_bar": found >= bar}
            results[name][f"{worlds}_worlds"] = cell
    finish(results)


if __name__ == "__main__":
    main()
