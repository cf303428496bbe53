"""The table of what was certified: a row for each preset and criterion."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

TABLE = Path(__file__).parents[2] / "results" / "presets" / "certified.csv"
SUMMARY = TABLE.with_suffix(".md")
"""The same for people: a line a preset."""
CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Criterion:
    """What a preset must fulfil: a range for a figure of success rates."""

    figure: str
    """``mean`` or ``sd`` over seeds."""
    least: float
    most: float

    def of(self, rates: Sequence[float]) -> float:
        """The figure of success rates ``[K]``, one of each seed."""
        return float(np.mean(rates) if self.figure == "mean" else np.std(rates, ddof=1))


CRITERIA = {
    "scripted": Criterion("mean", 0.9, 1.0),
    "untrained_greedy": Criterion("mean", 0.0, 0.02),
    "untrained_sampled": Criterion("mean", 0.0, 0.02),
    "bare_agent_mean": Criterion("mean", 0.1, 0.7),
    "bare_agent_sd": Criterion("sd", 0.1, 1.0),
}
"""Who can solve the task must be able to; who has not learnt must not; and of who has
learnt some seeds succeed and others fail, or no difference could show."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A preset and a criterion: the fields are the columns, all as texts."""

    preset: str
    criterion: str
    figure: str
    low: str
    high: str
    """95 % interval of the figure."""
    least: str
    most: str
    verdict: str
    """``pass`` or ``fail``."""
    success: str
    """Success rate of each seed, in the order of the seeds."""
    seeds: str
    episodes: str
    """Of each seed."""
    total_steps: str
    """Budget of the bare agent; nothing for the others."""
    settings: str
    """What was measured, as on the command line."""
    commit: str


def make_row(
    preset: str,
    criterion: str,
    rates: Sequence[float],
    *,
    seeds: Sequence[int],
    episodes: int,
    total_steps: int | None,
    settings: str,
    commit: str,
) -> Row:
    """A row from the success rates of seeds.

    Examples:
        >>> row = make_row(
        ...     "water_calm", "scripted", [0.95], seeds=[0], episodes=200,
        ...     total_steps=None, settings="task=water_calm", commit="1a2b3c4",
        ... )
        >>> row.figure, row.low, row.high, row.verdict
        ('0.9500', '0.9100', '0.9758', 'pass')
    """
    rule = CRITERIA[criterion]
    figure = rule.of(rates)
    low, high = interval(criterion, rates, episodes)
    return Row(
        preset=preset,
        criterion=criterion,
        figure=f"{figure:.4f}",
        low=f"{low:.4f}",
        high=f"{high:.4f}",
        least=f"{rule.least:g}",
        most=f"{rule.most:g}",
        # Not a number is in no range.
        verdict="pass" if rule.least <= figure <= rule.most else "fail",
        success=" ".join(f"{rate:.4f}" for rate in rates),
        seeds=" ".join(map(str, seeds)),
        episodes=str(episodes),
        total_steps="" if total_steps is None else str(total_steps),
        settings=settings,
        commit=commit,
    )


def interval(criterion: str, rates: Sequence[float], episodes: int) -> tuple[float, float]:
    """95 % interval of a figure.

    Seeds are drawn again (percentile bootstrap). Of a mean it is at least the exact
    binomial interval of all episodes: seeds that all fail say nothing of rarer successes.
    """
    if not np.isfinite(rates).all():
        return math.nan, math.nan
    rule = CRITERIA[criterion]
    lows, highs = [], []
    if len(rates) > 1:
        drawn = stats.bootstrap(
            (np.asarray(rates, dtype=float),),
            np.mean if rule.figure == "mean" else lambda x, axis: np.std(x, axis, ddof=1),
            confidence_level=CONFIDENCE,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
        lows, highs = [float(drawn.low)], [float(drawn.high)]
    if rule.figure == "mean":
        count = len(rates) * episodes
        successes = round(math.fsum(rates) * episodes)
        exact = stats.binomtest(successes, count).proportion_ci(CONFIDENCE)
        lows, highs = [*lows, float(exact.low)], [*highs, float(exact.high)]
    return min(lows, default=math.nan), max(highs, default=math.nan)


def read_table(path: Path = TABLE) -> list[Row]:
    """The rows of a table; none if there is no file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return [Row(**row) for row in csv.DictReader(file)]


def update_table(rows: Sequence[Row], path: Path = TABLE) -> list[Row]:
    """Write rows in the place of those of the same preset and criterion; all rows."""
    kept = {(row.preset, row.criterion): row for row in [*read_table(path), *rows]}
    order = list(CRITERIA)
    merged = sorted(kept.values(), key=lambda row: (row.preset, order.index(row.criterion)))
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        names = [field.name for field in dataclasses.fields(Row)]
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(dataclasses.asdict(row) for row in merged)
    return merged


def certified(rows: Sequence[Row]) -> dict[str, str]:
    """By preset: ``certified``, ``failed`` or ``not measured in full``."""
    verdicts: dict[str, dict[str, str]] = {}
    for row in rows:
        verdicts.setdefault(row.preset, {})[row.criterion] = row.verdict
    return {preset: _verdict(found) for preset, found in verdicts.items()}


def summary(rows: Sequence[Row]) -> str:
    """A table of Markdown with a line a preset: what was measured, and the verdict."""
    found = {(row.preset, row.criterion): row for row in rows}

    def cell(preset: str, criterion: str) -> str:
        row = found.get((preset, criterion))
        if row is None:
            return ""
        digits = f"{float(row.figure):.3f}"
        return f"**{digits}**" if row.verdict == "fail" else digits

    columns = ["preset", "verdict", "total steps", "seeds", *CRITERIA]
    lines = [columns, ["---"] * len(columns)]
    for preset, verdict in certified(rows).items():
        trained = found.get((preset, "bare_agent_mean"))
        budget = f"{int(trained.total_steps):,}" if trained else ""
        seeds = trained.seeds.split() if trained else []
        lines.append(
            [
                *(f"`{preset}`", verdict, budget),
                f"{seeds[0]} to {seeds[-1]}" if seeds else "",
                *(cell(preset, criterion) for criterion in CRITERIA),
            ]
        )
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _verdict(found: dict[str, str]) -> str:
    if "fail" in found.values():
        return "failed"
    return "certified" if found.keys() == CRITERIA.keys() else "not measured in full"
