"""Population evaluation against EvoTorch, which does it with processes.

    pip install -c constraints.txt -e '.[bench]'
    python -m benchmarks.evotorch_population

The fixed, untrained population of ``population_throughput``, 11 members over 20 episodes
each, through ``PopulationEvaluator`` and through EvoTorch's ``GymNE`` with two actors: the
same weights, networks of the same shapes, greedy actions, by turns in one run. Steps are
those of live worlds, and resets are inside the time. Members are handed to whichever
actor is free. ``GymNE`` steps one world at a time, so it gets the fastest form of one
that we know: the task's own functions around plain MuJoCo, which takes less time than
dm_control's environment or a simulation of one world. Exits with 2 where EvoTorch is not
installed. The last line is a JSON object with a key per task.
"""

from __future__ import annotations

import argparse
import functools
import importlib.metadata
import importlib.util
import logging
import os
import statistics
import sys
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")
os.environ.setdefault("EVOTORCH_VERBOSE_LEVEL", "0")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
# Ray's processes would otherwise give way to every other one.
os.environ.setdefault("RAY_worker_niceness", "0")

import mujoco
import numpy as np
import torch
from torch import nn

from benchmarks.common import finish, measure, ratio, show
from benchmarks.population_throughput import EPISODES, MEMBERS, make_population
from gdrl_tasks import Outcome, make_task, task_names
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

ACTORS = 2
BARS = {"indoor": 2.0, "water": 3.0}
"""Least ratio to EvoTorch."""
_ONE_WORLD = np.zeros(1, dtype=np.int64)
_SANE = np.zeros(1, dtype=bool)


class OneWorld:
    """A task in Gymnasium's form: spaces, ``reset`` and ``step``.

    Not a ``gymnasium.Env``, for ``GymNE`` asks for no more, and Gymnasium is not always
    installed. There is no check for a state that diverged.
    """

    def __init__(self, name: str) -> None:
        from gymnasium import spaces

        self.task = make_task(name)
        spec = self.task.spec
        low, high = (bound.astype(np.float32) for bound in spec.observation_bounds)
        self.observation_space = spaces.Box(low, high)
        if spec.is_discrete:
            self.action_space: Any = spaces.Discrete(spec.action_size)
        else:
            self.action_space = spaces.Box(-1.0, 1.0, (spec.action_size,))
        self.model = mujoco.MjModel.from_xml_string(self.task.xml())
        self.data = mujoco.MjData(self.model)
        self.arrays = self.task.allocate(1)
        # Live views, as of one world.
        data = self.data
        self._qpos, self._qvel = data.qpos[None], data.qvel[None]
        self._forces = data.xfrc_applied[None]
        self._fields = {
            field: getattr(self.model, field)[None] for field in self.task.model_fields
        }
        self._generator = np.random.default_rng()

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        seed = int(self._generator.integers(2**31 - 1))
        episode = self.task.draw_episode(seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = episode.qpos, episode.qvel
        self.task.begin_episode(self.arrays, _ONE_WORLD, episode, seed)
        if self._fields:
            self.task.write_model_fields(self._fields, self.arrays, _ONE_WORLD)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by a control step."""
        task, data, substeps = self.task, self.data, self.task.spec.num_substeps
        task.set_action(self.arrays, _ONE_WORLD, np.asarray(action)[None])
        if "control" in self.arrays:
            data.ctrl[:] = self.arrays["control"][0]
        if task.has_substep_forces:
            for _ in range(substeps):
                state = (self._qpos, self._qvel, np.array([data.time]), self._forces)
                task.apply_forces(self.arrays, _ONE_WORLD, *state)
                mujoco.mj_step(self.model, data)
        else:
            mujoco.mj_step(self.model, data, substeps)
        reward = task.finish_step(self.arrays, _ONE_WORLD, self._qpos, _SANE)
        ended = bool(self.arrays["outcome"][0] != Outcome.RUNNING)
        return self._observation(), float(reward[0]), ended, False, {}

    def _observation(self) -> np.ndarray:
        return self.task.observe(self.arrays, _ONE_WORLD, self._qpos, self._qvel)[0]


class ExpectedValues(nn.Module):
    """The mean returns of actions, of which ``GymNE`` takes the largest.

    Two streams of distributions as in the agent's network, and their expectation.
    """

    def __init__(self, network: Any, support: torch.Tensor) -> None:
        super().__init__()
        # Plain sequences: TorchRL's MLPs do more on every call.
        self.features = nn.Sequential(*network.features)
        self.advantage = nn.Sequential(*network.advantage)
        self.value = nn.Sequential(*network.value)
        self.register_buffer("support", support)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Values ``[A]`` for an observation ``[D]``."""
        features = self.features(observation)
        apart = self.advantage(features).view(-1, len(self.support))
        logits = apart - apart.mean(dim=0) + self.value(features)
        return logits.softmax(-1) @ self.support


def make_network(name: str) -> nn.Module:
    """The greedy policy of a task, its parameters in the order of the actor's."""
    torch.set_num_threads(1)
    actor, _ = make_population(name)
    if make_task(name).spec.is_discrete:
        return ExpectedValues(actor.module[0].module, actor.module[-1].support)
    return nn.Sequential(*actor.module[0].module[0], nn.Tanh())


def vectors_of(name: str) -> torch.Tensor:
    """The population as ``GymNE`` holds it, ``[P, N]``."""
    actor, population = make_population(name)
    paths = [tuple(path.split(".")) for path, _ in actor.named_parameters()]
    genes = [population.get(path, None) for path in paths]
    # What does not evolve is not in it.
    return torch.cat([gene.flatten(1) for gene in genes if gene is not None], dim=1)


def make_problem(name: str) -> tuple[Any, Any]:
    """EvoTorch's problem and its population."""
    from evotorch.neuroevolution import GymNE

    problem = GymNE(
        functools.partial(OneWorld, name),
        functools.partial(make_network, name),
        num_episodes=EPISODES,
        num_actors=ACTORS,
        subbatch_size=1,
    )
    batch = problem.generate_batch(MEMBERS)
    batch.set_values(vectors_of(name))
    return problem, batch


def measure_task(name: str, options: argparse.Namespace) -> list[list[float]]:
    """Rates of the evaluator and of EvoTorch.

    Raises:
        RuntimeError: If EvoTorch did not make the episodes that it was to make.
    """
    worlds, threads = MEMBERS * EPISODES, options.threads
    env = NavigationEnv(make_task(name), worlds, num_threads=threads, seed=0)
    actor, population = make_population(name)
    evaluator = PopulationEvaluator(actor, num_episodes=EPISODES, create_env_fn=lambda: env)
    problem, batch = make_problem(name)

    def evaluate() -> int:
        return int(evaluator.evaluate(population)["frames"].sum())

    def evaluate_its_way() -> int:
        steps, episodes = problem.interaction_count, problem.episode_count
        problem.evaluate(batch)
        if problem.episode_count - episodes != MEMBERS * EPISODES:
            raise RuntimeError(f"episodes: {problem.episode_count - episodes}")
        return problem.interaction_count - steps

    rates = measure(evaluate, evaluate_its_way, repeats=options.repeats)
    evaluator.close()
    problem.kill_actors()
    return rates


def main() -> None:
    """Measure both tasks and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    if importlib.util.find_spec("evotorch") is None:
        print(
            "EvoTorch is not installed: pip install -c constraints.txt -e '.[bench]'",
            file=sys.stderr,
        )
        sys.exit(2)
    import ray

    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    ray.init(
        num_cpus=ACTORS,
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
    )
    versions = {name: importlib.metadata.version(name) for name in ("evotorch", "ray")}
    results: dict[str, Any] = {"versions": versions, "actors": ACTORS}
    for name in task_names():
        rates = measure_task(name, options)
        own, its = map(statistics.median, rates)
        found = ratio(*rates)
        print(f"{name}: control steps per second, {MEMBERS} x {EPISODES}")
        show("PopulationEvaluator", own)
        show(f"EvoTorch, {ACTORS} actors", its)
        show("ratio", found, digits=2)
        results[name] = {
            "control_steps_per_s": round(own, 1),
            "evotorch_steps_per_s": round(its, 1),
            "ratio_to_evotorch": found,
        }
        if name in BARS:
            results[name] |= {"bar": BARS[name], "reaches_bar": found >= BARS[name]}
    ray.shutdown()
    finish(results)


if __name__ == "__main__":
    main()
