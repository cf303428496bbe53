"""A population's episodes directly on a simulation, without an environment between."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from gdrl_tasks import BatchSimulation, Outcome
from gdrl_torchrl import keys
from gdrl_torchrl.evolution.population.actor import PopulationActor
from gdrl_torchrl.evolution.population.blocks import (
    block_shapes,
    blocks_needed,
    fill_blocks,
)
from gdrl_torchrl.evolution.population.episodes import EpisodeLog
from gdrl_torchrl.evolution.population.rules import EvaluationRules

_ROWS_SHOWN = 3


def simulation_of(
    rules: EvaluationRules, population: PopulationActor, env: EnvBase
) -> BatchSimulation | None:
    """The simulation that an environment is a plain view of, or None.

    Also None if the evaluation needs something that only the environment has, or if an
    action depends on more than what its own world observes, because worlds act in blocks
    here.
    """
    # The attribute must be its own: wrappers pass on attributes of what they wrap.
    simulation = vars(env).get("simulation")
    if not isinstance(simulation, BatchSimulation):
        return None
    if rules.seeding != "reset":
        return None
    told = {keys.SUCCESS, *simulation.arrays}
    if not told.issuperset(map(str, rules.final_keys)):
        return None
    if population.in_keys != [keys.OBSERVATION]:
        return None
    spec: Any = env.full_observation_spec[keys.OBSERVATION]
    generator = torch.Generator().manual_seed(0)
    shown = torch.rand(_ROWS_SHOWN, spec.shape[-1], generator=generator) - 0.5
    rows = TensorDict({keys.OBSERVATION: shown.to(spec.dtype)}, batch_size=[_ROWS_SHOWN])
    return simulation if population.acts_row_by_row(rows) else None


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute on the calling thread only.

    Torch's own threads look for work for milliseconds after every operation, on the
    processors that the engine needs: with them an evaluation took 1.3 to 1.6 times as
    long.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


class SimulationRollout:
    """A ``PopulationRollout`` that makes no tensordict of the environment at each step.

    It steps only the worlds whose episodes go on. They act in blocks of a few rows, each
    with the weights of its member, and there are fewer blocks as episodes end. Many
    blocks act in parts, on as many threads as the simulation has. Nearly all of the time
    is then the engine's and the policy's.
    """

    def __init__(
        self,
        rules: EvaluationRules,
        population: PopulationActor,
        env: EnvBase,
        scores: TensorDictBase,
        seeds: torch.Tensor,
    ) -> None:
        self.rules, self.population, self.env = rules, population, env
        self.simulation: BatchSimulation = env.simulation  # pyright: ignore
        self.scores, self.seeds = scores, seeds
        self.first_member = 0
        members, trials = scores.batch_size
        self.shapes = block_shapes(members, trials, self.population.num_evolving)
        self.shape = self.shapes[0]
        self.run_all: Any = map
        self.act: Any = None

    def run(self, log: list[TensorDictBase] | None, offset: tuple[int, int]) -> None:
        """Fill the scores ``[p, s]``; append transitions to ``log``."""
        threads = min(self.simulation.num_threads, self.shape.parts)
        with ExitStack() as stack:
            stack.enter_context(one_torch_thread())
            if threads > 1:
                pool = ThreadPoolExecutor(threads, "gdrl-population")
                self.run_all = stack.enter_context(pool).map
            self._run(log, offset)

    def _run(self, log: list[TensorDictBase] | None, offset: tuple[int, int]) -> None:
        members, trials = self.scores.batch_size
        self.first_member = offset[0]
        simulation, count = self.simulation, members * trials
        live = np.arange(count)
        seeds = np.tile(self.seeds.numpy(), members)
        observation = simulation.reset(live, seeds).astype(np.float32)
        returns, steps = np.zeros(count), np.zeros(count, dtype=np.int64)
        finite, final = np.ones(count, dtype=bool), self._empty_finals(count)
        limit = self.rules.max_steps
        episodes = None if log is None else EpisodeLog(self.env, observation)
        slots = self._blocks(live, trials, None)
        where = np.empty(count, dtype=np.int64)
        while len(live):
            where[slots.ravel()] = np.arange(slots.size)
            rows = where[live]
            action, is_number = self._act(observation, slots)
            finite[live] &= is_number[rows]
            result = simulation.step(action[rows], live)
            observation[live] = result.observation
            # Rounded to float32, as an environment's rewards are.
            reward = result.reward.astype(np.float32)
            returns[live] += reward
            steps[live] += 1
            if episodes is not None:
                episodes.note(live, action[rows], reward, observation)
            ended = result.terminated | result.truncated
            if limit is not None:
                ended = ended | (steps[live] >= limit)
            if ended.any():
                self._note_finals(final, live[ended])
                live = live[~ended]
                slots = self._blocks(live, trials, slots)
        final |= {"return": returns.astype(np.float32), "steps": steps, "finite": finite}
        for name, value in final.items():
            shaped = torch.from_numpy(value).reshape(members, trials)
            self.scores.set_(name, shaped.to(self.scores[name].dtype))
        if log is not None and episodes is not None:
            log.append(episodes.transitions(trials, offset))

    def _act(
        self, observation: np.ndarray, slots: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions of the worlds in the slots, and whether they are numbers, ``[R]``."""
        chosen = torch.from_numpy(observation[slots])
        if self.act is None:
            inputs = TensorDict({keys.OBSERVATION: chosen}, batch_size=slots.shape)
            self.act = self.population.bind(
                inputs, parts=self.shape.parts, run_all=self.run_all
            )
        action, finite = self.act([chosen])
        return action.flatten(0, 1).numpy(), finite.flatten().numpy()

    def _blocks(
        self, live: np.ndarray, trials: int, slots: np.ndarray | None
    ) -> np.ndarray:
        """Worlds by block ``[K, B]``; loads the blocks' members if they change."""
        needed = blocks_needed(live, trials, self.shape.rows)
        shape = next(shape for shape in reversed(self.shapes) if shape.count >= needed)
        if slots is not None and (needed == 0 or shape == self.shape):
            return slots
        self.shape = shape
        slots, owners = fill_blocks(live, trials, shape)
        self.population.choose(self.first_member + torch.from_numpy(owners))
        self.act = None
        return slots

    def _empty_finals(self, count: int) -> dict[str, np.ndarray]:
        arrays: dict[str, Any] = self.simulation.arrays
        return {
            name: np.zeros(count, bool if key == keys.SUCCESS else arrays[str(key)].dtype)
            for key, name in self._final_names()
        }

    def _note_finals(self, final: dict[str, np.ndarray], worlds: np.ndarray) -> None:
        arrays = self.simulation.arrays
        for key, name in self._final_names():
            if key == keys.SUCCESS:
                final[name][worlds] = arrays["outcome"][worlds] == int(Outcome.SUCCESS)
            else:
                final[name][worlds] = arrays[str(key)][worlds]

    def _final_names(self) -> list[tuple[Any, str]]:
        return list(self.rules.final_keys.items())
