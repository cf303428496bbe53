"""Parts of a population side by side: one steps its worlds while another one acts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.modules.population_actor import PopulationActor
from gdrl_torchrl.transforms.population_rollout import PopulationRollout

if TYPE_CHECKING:
    from gdrl_torchrl.transforms.population_evaluator import PopulationEvaluator

Part = tuple[slice, slice]
"""Members and episodes that run as one batch."""


class Lane:
    """An environment, and the parts of a population that run in it one after another.

    Args:
        evaluator: Whose settings hold.
        env: The environment.
        population: Runs the members; no other lane may use it.
        params: Genomes ``[P]``.
        seeds: Episode seeds ``[S]``.
        scores: Gets the results, ``[P, S]``.
        parts: The parts.

    Attributes:
        log: Transitions, if they are kept.
    """

    def __init__(
        self,
        evaluator: PopulationEvaluator,
        env: EnvBase,
        population: PopulationActor,
        params: TensorDictBase,
        seeds: torch.Tensor,
        scores: TensorDictBase,
        parts: list[Part],
    ) -> None:
        self.evaluator, self.env, self.population = evaluator, env, population
        self.params, self.seeds, self.scores = params, seeds, scores
        self.parts = parts
        self.log: list[TensorDictBase] = []

    def can_have_a_thread(self) -> bool:
        """Whether nothing that it does touches what lanes share.

        A traced actor is a function of numbers; the modules themselves are changed
        while they act for a population, and random draws come from one generator.
        """
        if self.evaluator.exploration_type is not ExplorationType.DETERMINISTIC:
            return False
        example = self.env.fake_tensordict().select(*self.population.in_keys)
        row = example.reshape(-1)[:1]
        # All graphs are made now: tracing is not for several threads either.
        for members, episodes in self.parts:
            self.population.load(self.params[members])
            shape = (members.stop - members.start, episodes.stop - episodes.start)
            if not self.population.prepare(row.expand(*shape).clone()):
                return False
        return True

    @torch.no_grad()
    def run(self, *, keep_transitions: bool) -> None:
        """Run all parts."""
        # Modes of torch belong to a thread.
        with set_exploration_type(self.evaluator.exploration_type):
            try:
                for members, episodes in self.parts:
                    self.population.load(self.params[members])
                    PopulationRollout(
                        self.evaluator,
                        self.env,
                        self.population,
                        self.scores[members, episodes],
                        self.seeds[episodes],
                    ).run(
                        self.log if keep_transitions else None,
                        (members.start, episodes.start),
                    )
            finally:
                self.population.unload()


def run_lanes(lanes: list[Lane], *, keep_transitions: bool) -> None:
    """Run lanes, each on a thread if all can have one, else one after another."""
    busy = [lane for lane in lanes if lane.parts]
    if len(busy) < 2 or not all(lane.can_have_a_thread() for lane in busy):
        for lane in busy:
            lane.run(keep_transitions=keep_transitions)
        return
    with ThreadPoolExecutor(len(busy) - 1, "gdrl-lane") as pool:
        others = [
            pool.submit(lane.run, keep_transitions=keep_transitions) for lane in busy[1:]
        ]
        busy[0].run(keep_transitions=keep_transitions)
        for other in others:
            other.result()
