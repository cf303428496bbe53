"""What a search for good settings can be told."""

from __future__ import annotations

import dataclasses

from gdrl_torchrl.checks import (
    MOST_EPISODES,
    MOST_SEED,
    MOST_STEPS,
    among,
    check_fields,
    check_folder,
    limits,
    within,
)


@dataclasses.dataclass
class SearchConfig:
    """Trials of settings, judged by the success rate on worlds of their own.

    Examples:
        >>> SearchConfig(params={"seed": "choice(0, 1)"}, total_steps=[20, 10])
        Traceback (most recent call last):
        ValueError: search.total_steps=[20, 10] must be ascending
    """

    name: str = "search"
    """Folder of its runs, and of its trials, in ``runs_dir``."""
    overrides: list[str] = dataclasses.field(default_factory=list)
    """What all its runs have in common, as on the command line."""
    params: dict[str, str] = dataclasses.field(default_factory=dict)
    """Values to choose from, as a sweep would write them: ``choice(5, 10)``,
    ``range(1, 4)``, ``interval(0.1, 1)``, ``tag(log, interval(0.01, 1))``,
    ``int(interval(5, 50))``."""
    num_trials: int = within(20, least=1, most=100_000)
    """Settings that are tried."""
    total_steps: list[int] = dataclasses.field(
        default_factory=lambda: [100_000],
        metadata=limits(lengths=(1, 100), least=1, most=MOST_STEPS),
    )
    """Budgets of a trial, one after another; after each but the last it is ended if it
    is worse than the median of the trials before it."""
    seeds: list[int] = dataclasses.field(
        default_factory=lambda: [0],
        metadata=limits(lengths=(1, 1000), least=0, most=MOST_SEED),
    )
    """Seeds that a trial is trained with; its value is their mean."""
    episodes: int = within(200, least=1, most=MOST_EPISODES)
    """Held-out episodes that decide."""
    evaluation_seed: int = within(1, least=0, most=MOST_SEED)
    """Seed of the worlds that decide. Not that of the reports (0), for the best of many
    trials is partly the luckiest in its worlds."""
    sampler_seed: int = within(0, least=0, most=2**31)
    """Trials add their number to it; NumPy's seeds have 32 bits."""
    storage: str = among("journal", ("journal", "sqlite"))
    """``journal``, a file that many processes may append to, or ``sqlite``."""

    def __post_init__(self) -> None:
        check_fields(self, "search")
        check_folder("search.name", self.name)
        if not self.params:
            raise ValueError("search.params={} must not be empty")
        if sorted(set(self.total_steps)) != self.total_steps:
            raise ValueError(f"search.total_steps={self.total_steps} must be ascending")
