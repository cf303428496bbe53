"""What a contest is worth: agent, winner and children, scored again on worlds of their own.

    python results/contests/measure.py water 800     # adds to results/contests/water.csv
    python results/contests/measure.py --table       # prints the table of the README

A run trains as ever; after every contest its members are evaluated on fresh worlds too,
greedily, which is in no count of steps and changes nothing of the run.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import statistics
import sys
from pathlib import Path
from typing import Any, cast

import torch

from gdrl_tasks import Stream, episode_seeds
from gdrl_torchrl import keys
from gdrl_torchrl.cli.shared.compose import load_experiment, register_configs
from gdrl_torchrl.evolution.hooks.contest import PARENT, Contest, Match, Verdict
from gdrl_torchrl.runs.build import Training, build_training

HERE = Path(__file__).parent
SETTINGS = {
    "water": (["experiment=gppo_water", "+regime=little_data"], 400_000),
    "indoor": (["experiment=grainbow_indoor", "+tuned=rainbow_indoor"], 300_000),
}
"""By name: overrides and total steps."""
WORLDS, WORLDS_OF_CHILD = 400, 100
BANDS = [(0.0, 0.2), (0.2, 0.8), (0.8, 0.95), (0.95, 1.01)]
COLUMNS = [
    *("seed", "contest", "total_steps", "contest_steps"),
    *("seen_agent", "seen_winner", "switched"),
    *("agent", "winner", "children_mean", "children_best", "children_sd"),
]


class Measured:
    """A contest whose members are scored again."""

    def __init__(self, contest: Contest) -> None:
        self.contest = contest
        self.rows: list[dict[str, float]] = []

    def __call__(self, match: Match) -> Verdict:
        """Let the members compete, then look."""
        verdict = self.contest(match)
        self.rows.append(self.look(match, verdict))
        return verdict

    def look(self, match: Match, verdict: Verdict) -> dict[str, float]:
        """What the contest saw, and what is so."""

        def rates(members: list[int], worlds: int, first: int) -> list[float]:
            # Worlds of the winner are not those that the children were looked at on.
            seeds = episode_seeds(Stream.EVALUATION, len(self.rows), first, worlds)
            seeds = torch.from_numpy(seeds)
            scores = match.evaluator.evaluate(match.population[members], seeds=seeds)
            return cast(list[float], scores[keys.SUCCESS_RATE].tolist())

        seen = verdict.scores[keys.SUCCESS_RATE]
        agent, winner = rates([PARENT, verdict.winner], WORLDS, 0)
        children = rates(
            list(range(1, match.population.batch_size[0])), WORLDS_OF_CHILD, WORLDS
        )
        # Chance in the episodes widens the scatter of children; what is left is their own.
        chance = statistics.fmean(r * (1.0 - r) / (WORLDS_OF_CHILD - 1) for r in children)
        own = max(statistics.variance(children) - chance, 0.0)
        return {
            "contest": len(self.rows),
            "contest_steps": int(verdict.scores[keys.FRAMES].sum()),
            "seen_agent": float(seen[PARENT]),
            "seen_winner": float(seen[verdict.winner]),
            "switched": int(verdict.winner != PARENT),
            "agent": agent,
            "winner": winner,
            "children_mean": statistics.fmean(children),
            "children_best": max(children),
            "children_sd": own**0.5,
        }


def train(overrides: list[str], total_steps: int, seed: int) -> list[dict]:
    """Rows of a run."""
    config = load_experiment([*overrides, f"seed={seed}", "simulation.num_threads=1"])
    torch.manual_seed(seed)
    training = build_training(config)
    hook = cast(Any, training.evolution)
    measured = Measured(hook.contest)
    hook.contest = measured

    def after_a_step() -> None:
        spent = _total_steps(training)
        for row in measured.rows:
            row.setdefault("total_steps", spent)
        if spent >= total_steps:
            training.loop.request_stop()

    training.loop.register_op("post_steps", after_a_step)
    try:
        training.loop.train()
    finally:
        training.close()
    return [{"seed": seed} | row for row in measured.rows]


def _total_steps(training: Training) -> int:
    counts = cast(Any, training.evolution).counts
    return training.loop.collected_frames + counts.steps


def table(name: str) -> list[str]:
    """Lines of a setting's table, by success of the agent before the contest."""
    with (HERE / f"{name}.csv").open(newline="") as lines:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(lines)]
    after = [row for row in itertools.pairwise(rows) if row[0]["seed"] == row[1]["seed"]]
    found = []
    for low, high in BANDS:
        band = [row for row in rows if low <= row["agent"] < high]
        if not band:
            continue
        gains = [row["winner"] - row["agent"] for row in band]
        error = statistics.stdev(gains) / len(gains) ** 0.5
        steps = [row["contest_steps"] for row in band]
        # Until the next contest the agent learns alone.
        alone = [pair for pair in after if low <= pair[0]["agent"] < high]
        learnt = [then["agent"] - now["winner"] for now, then in alone]
        taken = [
            then["total_steps"] - then["contest_steps"] - now["total_steps"]
            for now, then in alone
        ]
        cells = [
            name,
            f"{low:g} to {min(high, 1.0):g}",
            str(len(band)),
            f"{statistics.fmean(row['switched'] for row in band):.2f}",
            f"{statistics.fmean(r['seen_winner'] - r['seen_agent'] for r in band):+.3f}",
            f"{statistics.fmean(gains):+.3f} ({error:.3f})",
            f"{statistics.fmean(r['children_mean'] - r['agent'] for r in band):+.3f}",
            f"{statistics.fmean(row['children_sd'] for row in band):.3f}",
            f"{statistics.fmean(steps):,.0f}",
            f"{1e4 * sum(gains) / sum(steps):+.3f}",
            f"{1e4 * sum(learnt) / sum(taken):+.3f}",
        ]
        found.append(f"| {' | '.join(cells)} |")
    return found


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("setting", nargs="?", choices=SETTINGS)
    parser.add_argument("seeds", type=int, nargs="*")
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    if options.table:
        names = [name for name in SETTINGS if (HERE / f"{name}.csv").exists()]
        sys.stdout.writelines(f"{line}\n" for name in names for line in table(name))
        return
    register_configs()
    file = HERE / f"{options.setting}.csv"
    for seed in options.seeds:
        rows = train(*SETTINGS[options.setting], seed)
        is_new = not file.exists()
        with file.open("a", newline="") as lines:
            writer = csv.DictWriter(lines, COLUMNS, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerows(
                {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}
                for row in rows
            )


if __name__ == "__main__":
    main()
