"""What a search for good settings can be told."""

from __future__ import annotations

import dataclasses

from gdrl_torchrl.config.checks import check_choice, check_folder, check_range


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
    num_trials: int = 20
    total_steps: list[int] = dataclasses.field(default_factory=lambda: [100_000])
    """Budgets of a trial, one after another; after each but the last it is ended if it
    is worse than the median of the trials before it."""
    seeds: list[int] = dataclasses.field(default_factory=lambda: [0])
    """Seeds that a trial is trained with; its value is their mean."""
    episodes: int = 200
    evaluation_seed: int = 1
    """Seed of the worlds that decide. Not that of the reports (0), for the best of many
    trials is partly the luckiest in its worlds."""
    sampler_seed: int = 0
    storage: str = "journal"
    """``journal``, a file that many processes may append to, or ``sqlite``."""

    def __post_init__(self) -> None:
        check_folder("search.name", self.name)
        check_choice("search.storage", self.storage, ("journal", "sqlite"))
        for name in ("num_trials", "episodes"):
            check_range(f"search.{name}", getattr(self, name), least=1)
        for name in ("evaluation_seed", "sampler_seed"):
            check_range(f"search.{name}", getattr(self, name), least=0)
        for name in ("params", "total_steps", "seeds"):
            if not getattr(self, name):
                raise ValueError(f"search.{name} must not be empty")
        check_range("search.total_steps", min(self.total_steps), least=1)
        if sorted(set(self.total_steps)) != self.total_steps:
            raise ValueError(f"search.total_steps={self.total_steps} must be ascending")
