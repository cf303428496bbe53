"""What holds for one evaluation: how episodes are chosen, what is read, what is fitness."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl import keys

_logger = logging.getLogger(__name__)

_EXPLORATION: dict[str, Any] = {
    "greedy": ExplorationType.DETERMINISTIC,
    "sampled": ExplorationType.RANDOM,
}
Fitness = str | Callable[[TensorDictBase], torch.Tensor]


def exploration_of(act: str) -> Any:
    """TorchRL's name of how members act: ``greedy`` or ``sampled``.

    Examples:
        >>> exploration_of("greedy").name
        'DETERMINISTIC'
    """
    return _EXPLORATION[act]


@contextlib.contextmanager
def acting(kind: Any, seed: int) -> Iterator[None]:
    """Let policies act in a TorchRL ``ExplorationType`` for the time of an evaluation.

    Unless they act greedily, torch's generator is seeded, and as before afterwards: an
    evaluation depends on no draws of others, and changes none.
    """
    with contextlib.ExitStack() as stack:
        if kind != ExplorationType.DETERMINISTIC:
            stack.enter_context(torch.random.fork_rng(devices=[]))
            torch.manual_seed(seed)
        stack.enter_context(set_exploration_type(kind))
        yield


@dataclasses.dataclass(frozen=True)
class EvaluationRules:
    """The rules of one evaluation, worked out once for its environment."""

    seeding: str
    """How episodes are chosen: ``reset``, ``set_seed`` or ``none``."""
    final_keys: dict[NestedKey, str]
    """Entries to read at the end of an episode, and the names they get."""
    final_types: dict[str, torch.dtype]
    """Their types, by those names."""
    max_steps: int | None
    """Steps after which an episode is cut off."""
    fitness: Fitness

    @classmethod
    def of(
        cls,
        env: EnvBase,
        *,
        episode_seeding: str,
        success_key: NestedKey,
        extra_keys: tuple[str, ...],
        max_steps: int | None,
        fitness: Fitness,
    ) -> EvaluationRules:
        """The rules for an environment; arguments as of ``PopulationEvaluator``.

        Raises:
            ValueError: If the environment lacks an extra key, or ``success`` where goals
                are the fitness.
        """
        spec = env.full_observation_spec
        offered = set(spec.keys(True, True))
        if missing := [key for key in extra_keys if key not in offered]:
            raise ValueError(f"extra_keys={missing} are not entries of the environment")
        if fitness == "goals" and success_key not in offered:
            raise ValueError(
                f"fitness='goals' needs the entry {success_key!r} of the environment, "
                "which it has not: choose fitness='return' or another success_key"
            )
        wanted = {success_key: keys.SUCCESS, keys.OUTCOME: keys.OUTCOMES}
        wanted |= {key: key for key in extra_keys}
        final = {key: name for key, name in wanted.items() if key in offered}
        seeding = episode_seeding
        if seeding == "auto":
            seeding = "reset" if keys.EPISODE_SEED in offered else "set_seed"
        types = {name: spec[key].dtype for key, name in final.items()}
        return cls(seeding, final, types, max_steps, fitness)

    def empty_scores(self, members: int, episodes: int) -> TensorDict:
        """What rollouts fill, ``[P, S]``."""
        shape = (members, episodes)
        types = {
            "return": torch.float32,
            "steps": torch.int64,
            keys.SUCCESS: torch.bool,
            **self.final_types,
        }
        entries = {name: torch.zeros(shape, dtype=dtype) for name, dtype in types.items()}
        entries["finite"] = torch.ones(shape, dtype=torch.bool)
        return TensorDict(entries, batch_size=shape)

    def summary(self, scores: TensorDictBase) -> TensorDictBase:
        """The result ``[P]`` of filled scores ``[P, S]``, with the fitness."""
        success: Any = scores[keys.SUCCESS]
        result = TensorDict(
            {
                keys.SUCCESSES: success,
                keys.RETURNS: scores["return"],
                keys.STEPS: scores["steps"],
                keys.SUCCESS_RATE: success.float().mean(dim=1),
                keys.RETURN_MEAN: scores["return"].mean(dim=1),
                keys.FRAMES: scores["steps"].sum(dim=1),
            },
            batch_size=scores.batch_size[:1],
        )
        for name in self.final_types:
            if name != keys.SUCCESS:
                result[name] = scores[name]
        if callable(self.fitness):
            fitness = self.fitness(result).float()
        elif self.fitness == "goals":
            fitness = success.sum(dim=1).float()
        else:
            fitness = result[keys.RETURN_MEAN].clone()
        broken_policy = ~scores.get("finite").all(dim=1)
        broken_return = ~torch.isfinite(scores["return"]).all(dim=1)
        fitness = fitness.masked_fill(broken_policy | broken_return, torch.nan)
        if bool(torch.isnan(fitness).all()):
            _logger.warning(
                "fitness is NaN for all %d members: actions are no numbers for %d, returns "
                "for %d",
                *(len(fitness), int(broken_policy.sum()), int(broken_return.sum())),
            )
        return result.set(keys.FITNESS, fitness)
