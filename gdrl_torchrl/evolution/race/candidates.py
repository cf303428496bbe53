"""Members of a race: who plays on, and from whom children are made."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

_NEW_PRIOR = (0.2, 2.0)
"""Success of a new member, as a beta distribution: nearly all have none, few have much."""
_OLD_PRIOR = (0.5, 1.5)
"""Of a member that has reached a goal, before its episodes are counted."""


@dataclasses.dataclass
class Candidate:
    """A member, with what it has played."""

    genome: TensorDictBase
    """``[]``."""
    origin: str
    """``new`` or ``distilled``."""
    successes: int = 0
    episodes: int = 0

    @property
    def again(self) -> tuple[int, int]:
        """Successes and episodes without the first, for which it was kept.

        The first success is that of the luckiest of many; those after it are not.
        """
        return max(0, self.successes - 1), max(0, self.episodes - 1)

    def add(self, successes: int, episodes: int = 1) -> None:
        """Count episodes."""
        self.successes += successes
        self.episodes += episodes


class Candidates:
    """The best members so far, drawn from in proportion to what they may be worth.

    Whoever plays is drawn by Thompson sampling (Thompson 1933): success of each candidate,
    and of a new member, is drawn from a beta distribution, and the highest one plays. Good
    ones are drawn again, and new ones as long as nothing is good.

    Args:
        most: How many are kept: those with the highest share of successes.

    Examples:
        >>> candidates = Candidates(most=2)
        >>> best = Candidate(TensorDict(), "new", successes=3, episodes=4)
        >>> candidates.keep([best, Candidate(TensorDict(), "new", episodes=1)])
        >>> len(candidates)
        1
        >>> candidates.draw(np.random.default_rng(0)) is best
        True
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.kept: list[Candidate] = []

    def __len__(self) -> int:
        return len(self.kept)

    def keep(self, played: Iterable[Candidate]) -> None:
        """Keep the best of those that are kept and those that have played.

        Without a success none is kept.
        """
        everyone = {id(one): one for one in [*self.kept, *played] if one.successes}
        ranked = sorted(
            everyone.values(), key=lambda c: -(c.successes + 0.5) / (c.episodes + 1.5)
        )
        self.kept = ranked[: self.most]

    def draw(
        self, rng: np.random.Generator, busy: Iterable[Candidate] = ()
    ) -> Candidate | None:
        """Who plays next; None means a new member.

        Args:
            rng: Source of randomness.
            busy: Candidates that play already.
        """
        taken = {id(one) for one in busy}
        free = [one for one in self.kept if id(one) not in taken]
        if not free:
            return None
        won = np.array([one.successes for one in free])
        lost = np.array([one.episodes for one in free]) - won
        worth = rng.beta(_OLD_PRIOR[0] + won, _OLD_PRIOR[1] + lost)
        best = int(worth.argmax())
        return free[best] if worth[best] > rng.beta(*_NEW_PRIOR) else None

    def promising(self, least_success: float) -> Candidate | None:
        """The best with two successes after its first, and at least this share of them."""
        best, most = None, 0.0
        for one in self.kept:
            successes, episodes = one.again
            worth = successes / (episodes + 1)
            if successes >= 2 and successes >= least_success * episodes and worth > most:
                best, most = one, worth
        return best

    def clear(self) -> None:
        """Forget all of them."""
        self.kept = []

    def state_dict(self) -> dict[str, Any]:
        """The candidates, in their order."""
        genomes: Any = torch.stack([c.genome for c in self.kept]) if self.kept else None
        return {
            "genomes": None if genomes is None else genomes.to_dict(),
            "origins": [one.origin for one in self.kept],
            "records": [[one.successes, one.episodes] for one in self.kept],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.kept = []
        records = state_dict["records"]
        if not records:
            return
        genomes = TensorDict(state_dict["genomes"], batch_size=[len(records)])
        for genome, origin, record in zip(
            genomes, state_dict["origins"], records, strict=True
        ):
            self.kept.append(Candidate(genome.clone(), str(origin), *map(int, record)))
