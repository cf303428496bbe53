"""How often contests replace an agent by a child, with members that succeed by chance.

    python results/paired_rule/measure.py > results/paired_rule/switches.csv

Every member has a chance of success of its own; its episodes are independent, and all last
as long. Which child is the better one is drawn, for ties go to the lower number. The same
seeds give the same table.
"""

import csv
import sys
from typing import Any, cast

import torch
from tensordict import TensorDict

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.contest import FullContest, Match, PairedContest

CONTESTS = 2000
CHILDREN = 10
CASES = [
    *((parent, "as good", [parent] * CHILDREN) for parent in (0.1, 0.3, 0.5, 0.7, 0.9)),
    *(
        (parent, f"one of {best:g}, nine as good", [best] + [parent] * (CHILDREN - 1))
        for parent, best in ((0.3, 0.5), (0.3, 0.7), (0.5, 0.9))
    ),
    *((0.5, f"all {child:g}", [child] * CHILDREN) for child in (0.3, 0.1)),
]


class ByChance:
    """Scores members by chance, as an evaluator does by episodes."""

    num_episodes = 10
    fitness = "goals"

    def __init__(self, chances: list[float], seed: int) -> None:
        self.chances = torch.tensor(chances)
        self.generator = torch.Generator().manual_seed(seed)

    def fresh_seeds(self, count: int) -> torch.Tensor:
        """Seeds ``[count]`` of episodes, which mean nothing here."""
        return torch.zeros(count, dtype=torch.int64)

    def evaluate(self, population: Any, *, seeds: torch.Tensor | None = None) -> TensorDict:
        """Scores ``[M]`` of members."""
        trials = self.num_episodes if seeds is None else len(seeds)
        chance = self.chances[population["member"]][:, None]
        drawn = torch.rand(len(chance), trials, generator=self.generator)
        successes = drawn < chance
        values = successes.float()
        return TensorDict(
            {
                keys.SUCCESSES: successes,
                keys.RETURNS: values,
                keys.RETURN_MEAN: values.mean(dim=1),
                keys.SUCCESS_RATE: values.mean(dim=1),
                keys.FITNESS: values.sum(dim=1),
                keys.FRAMES: torch.full((len(chance),), trials),
            },
            batch_size=[len(chance)],
        )


def switches(contest: Any, chances: list[float]) -> tuple[float, float]:
    """Share of contests that a child wins, and mean episodes of a contest."""
    members = torch.arange(len(chances))
    population = TensorDict(member=members, batch_size=[len(chances)])
    won, episodes = 0, 0
    for seed in range(CONTESTS):
        generator = torch.Generator().manual_seed(seed)
        children = (torch.randperm(len(chances) - 1, generator=generator) + 1).tolist()
        drawn = [chances[0], *(chances[child] for child in children)]
        evaluator = cast(Any, ByChance(drawn, seed))
        verdict = contest(Match(evaluator, population, generator))
        won += verdict.winner != 0
        episodes += int(verdict.scores[keys.FRAMES].sum())
    return won / CONTESTS, episodes / CONTESTS


if __name__ == "__main__":
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(["parent", "children", "paired", "full", "paired_episodes_over_full"])
    for parent, children, chances in CASES:
        paired, paired_episodes = switches(PairedContest(), [parent, *chances])
        full, full_episodes = switches(FullContest(), [parent, *chances])
        ratio = paired_episodes / full_episodes
        table.writerow([parent, children, paired, full, f"{ratio:.2f}"])
