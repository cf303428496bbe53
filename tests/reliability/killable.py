"""``gdrl-train`` that is killed at a moment: python killable.py '<moment>' <overrides>.

The moment is JSON: ``row``, after how many rows of ``metrics.csv`` it may come; ``kind``
and ``stage``, what the process is in the middle of; ``log``, a file that gets a line
before the kill. Nothing but SIGKILL happens to what the process does.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

from gdrl_tasks.engines.batch import BatchSimulation
from gdrl_torchrl.cli import train
from gdrl_torchrl.evolution.hooks import hand_over as hand_over_module
from gdrl_torchrl.evolution.hooks.hand_over import HandOver
from gdrl_torchrl.evolution.operators import genome
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.runs import checkpoint

SAVING = ("half a file", "before flush", "before rename", "before names", "before prune")
HAND_OVER = ("before", "weights installed", "after")
MOST_ROWS_LATE = 15
"""If what is waited for has not come by then, the process is killed all the same."""


class Moment:
    """Waits for a moment and kills this process then."""

    def __init__(self, row: int, kind: str, stage: int, log: str) -> None:
        self.row, self.kind, self.stage, self.log = row, kind, stage, Path(log)
        self.rows = 0

    def is_due(self, kind: str, stage: int = 0) -> bool:
        return self.rows >= self.row and (kind, stage) == (self.kind, self.stage)

    def note(self, kind: str, stage: int) -> None:
        line = {"kind": kind, "stage": stage, "rows": self.rows}
        with self.log.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def kill(self, kind: str, stage: int = 0) -> None:
        self.note(kind, stage)
        os.kill(os.getpid(), signal.SIGKILL)

    def kill_if_due(self, kind: str, stage: int = 0) -> None:
        if self.is_due(kind, stage):
            self.kill(kind, stage)


def watch_rows(moment: Moment) -> None:
    append = MetricsTable.append

    def append_and_count(table, row):
        append(table, row)
        moment.rows = table.path.read_text().count("\n") - 1
        if moment.is_due("anywhere"):
            # Whoever started this process kills it a little later.
            moment.note("anywhere", 0)
            print("ready", flush=True)
            moment.row = sys.maxsize
        if moment.rows >= moment.row + MOST_ROWS_LATE:
            moment.kill("late")

    MetricsTable.append = append_and_count


def watch_saving(moment: Moment) -> None:
    write_bytes, flush = Path.write_bytes, checkpoint.flush_to_disk
    prune, replace = checkpoint.Checkpoints._prune, os.replace

    def write(path, data):
        if path.name == "state.safetensors" and moment.is_due("saving", 0):
            write_bytes(path, data[: len(data) // 2])
            moment.kill("saving", 0)
        return write_bytes(path, data)

    def flush_file_or_folder(path):
        if path.name == "checkpoints":
            moment.kill_if_due("saving", 3)
        elif path.name.startswith(".checkpoint"):
            moment.kill_if_due("saving", 1)
        flush(path)

    def rename(source, target):
        if Path(target).name.startswith("checkpoint-"):
            moment.kill_if_due("saving", 2)
        replace(source, target)

    def prune_old(checkpoints, newest):
        moment.kill_if_due("saving", 4)
        return prune(checkpoints, newest)

    Path.write_bytes, checkpoint.flush_to_disk = write, flush_file_or_folder
    os.replace, checkpoint.Checkpoints._prune = rename, prune_old


def watch_evaluation(moment: Moment) -> None:
    evaluate, step = PopulationEvaluator._evaluate, BatchSimulation.step
    steps_left = None

    def evaluate_and_count(evaluator, *args, **kwargs):
        nonlocal steps_left
        if moment.kind == "evaluation" and moment.rows >= moment.row:
            steps_left = moment.stage
        found = evaluate(evaluator, *args, **kwargs)
        steps_left = None
        return found

    def step_or_die(simulation, *args, **kwargs):
        nonlocal steps_left
        if steps_left is not None:
            if steps_left == 0:
                moment.kill("evaluation", moment.stage)
            steps_left -= 1
        return step(simulation, *args, **kwargs)

    PopulationEvaluator._evaluate, BatchSimulation.step = evaluate_and_count, step_or_die


def watch_hand_over(moment: Moment) -> None:
    hand_over, install = HandOver.install, genome.install

    def hand_over_or_die(part, *args):
        moment.kill_if_due("hand-over", 0)
        hand_over(part, *args)
        moment.kill_if_due("hand-over", 2)

    def install_or_die(*args):
        install(*args)
        moment.kill_if_due("hand-over", 1)

    HandOver.install, hand_over_module.install = hand_over_or_die, install_or_die


if __name__ == "__main__":
    moment = Moment(**json.loads(sys.argv.pop(1)))
    for watch in (watch_rows, watch_saving, watch_evaluation, watch_hand_over):
        watch(moment)
    train.main()
