"""How strongly to mutate, by the agent's current success."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class MutationSchedule:
    """Mutation probability by success rate: ``rates[i]`` below ``thresholds[i]``.

    The papers give the rates (0.75, 0.4, 0.1) and not the thresholds.

    Examples:
        >>> schedule = MutationSchedule()
        >>> [schedule(success) for success in (None, 0.2, 0.5, 0.9)]
        [0.75, 0.75, 0.4, 0.1]
    """

    rates: tuple[float, ...] = (0.75, 0.4, 0.1)
    thresholds: tuple[float, ...] = (0.4, 0.8)

    def __post_init__(self) -> None:
        if len(self.rates) != len(self.thresholds) + 1:
            raise ValueError(
                f"rates={self.rates} must have one entry more than "
                f"thresholds={self.thresholds}"
            )
        if any(not 0.0 <= rate <= 1.0 for rate in self.rates):
            raise ValueError(f"rates={self.rates} must be in [0, 1]")
        if list(self.thresholds) != sorted(set(self.thresholds)):
            raise ValueError(f"thresholds={self.thresholds} must increase")

    def __call__(self, success_rate: float | None) -> float:
        """Rate for a success rate; None (not known yet) means the highest mutation."""
        if success_rate is None:
            return self.rates[0]
        return self.rates[sum(success_rate >= limit for limit in self.thresholds)]
