"""What mutations find before anything was learnt: children of agents with new weights.

    python results/first_children/measure.py water_calm    # adds to first_children.csv
    python results/first_children/measure.py --table       # prints the table of the README

Nothing is trained. Fifty children of each of four new agents play twenty episodes.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
from pathlib import Path
from typing import Any, cast

import torch

from gdrl_torchrl import keys
from gdrl_torchrl.cli.shared.compose import load_experiment, register_configs
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.runs.build import build_training

FILE = Path(__file__).with_name("first_children.csv")
WATER = ["experiment=gppo_water", "+tuned=ppo_water"]
INDOOR = ["experiment=grainbow_indoor", "+tuned=rainbow_indoor"]
SETTINGS = {
    "water_calm": (WATER, ("greedy", "sampled")),
    "water_precise": (WATER, ("greedy", "sampled")),
    "indoor_sparse": (INDOOR, ("greedy",)),
    "indoor_scatter_sparse": (INDOOR, ("greedy",)),
}
"""By preset: overrides, and how members act. Rainbow's own exploration is no policy."""
STDS = (0.0, 0.03, 0.1, 0.3, 0.86, 2.0)
"""Of the noise on three of four weights; 0.86 is what a search of GPPO has found."""
SEEDS, CHILDREN, TRIALS, MUT_P = range(4), 50, 20, 0.75
GOOD = 0.1
COLUMNS = ["preset", "act", "std", "seed", "mean", "best", "good"]


def children_of(preset: str, act: str, std: float, seed: int) -> dict[str, Any]:
    """Success of one new agent's children."""
    overrides, _ = SETTINGS[preset]
    options = [f"num_children={CHILDREN}", f"num_trials={TRIALS}", f"act={act}"]
    config = load_experiment(
        [
            f"task={preset}",
            *overrides,
            *(f"evolution.{option}" for option in options),
            f"seed={seed}",
            "simulation.num_threads=1",
        ]
    )
    torch.manual_seed(seed)
    training = build_training(config)
    try:
        children = bernoulli_mutation(
            stack_copies(genome_of(training.agent.actor), CHILDREN),
            mut_p=MUT_P,
            std=std,
            generator=torch.Generator().manual_seed(seed),
        )
        scores = cast(Any, training.evolution).evaluator.evaluate(children)
    finally:
        training.close()
    rates: list[float] = scores[keys.SUCCESS_RATE].tolist()
    return {
        "mean": round(statistics.fmean(rates), 4),
        "best": round(max(rates), 4),
        "good": round(statistics.fmean(rate >= GOOD for rate in rates), 4),
    }


def table() -> list[str]:
    """Lines of the table: means over agents, and the best child of all."""
    with FILE.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    found = []
    for preset, act, std in dict.fromkeys((r["preset"], r["act"], r["std"]) for r in rows):
        own = [r for r in rows if (r["preset"], r["act"], r["std"]) == (preset, act, std)]
        mean, good = (statistics.fmean(float(r[k]) for r in own) for k in ("mean", "good"))
        best = max(float(r["best"]) for r in own)
        cells = [preset, act, std, f"{mean:.3f}", f"{good:.2f}", f"{best:.2f}"]
        found.append(f"| {' | '.join(cells)} |")
    return found


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("presets", nargs="*", choices=[*SETTINGS, []])
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    if options.table:
        sys.stdout.writelines(f"{line}\n" for line in table())
        return
    register_configs()
    for preset in options.presets:
        is_new = not FILE.exists()
        with FILE.open("a", newline="") as lines:
            writer = csv.DictWriter(lines, COLUMNS, lineterminator="\n")
            if is_new:
                writer.writeheader()
            for act in SETTINGS[preset][1]:
                for std in STDS:
                    for seed in SEEDS:
                        made_with = {"preset": preset, "act": act, "std": std, "seed": seed}
                        writer.writerow(made_with | children_of(preset, act, std, seed))
                        lines.flush()


if __name__ == "__main__":
    main()
