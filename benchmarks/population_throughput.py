"""Control steps per second of population evaluation, and of what it could be done with.

    python -m benchmarks.population_throughput

One fixed, untrained population of 11 members over 20 episodes each, measured in one run
through: ``PopulationEvaluator``; the raw engine stepping every world of the same model
with one ``step(nstep=...)`` per control step, with its scenery and without (as batches
step it), at rest and, where the model has actuators, driven by random actions (contacts
that slip cost the engine more); the
dm_control environment alone; and TorchRL's ``ParallelEnv`` of ``DMControlWrapper``
environments, as a TorchRL user would write it. Evaluator and engine take turns. Steps
are those of live worlds, and resets are inside the time. The last line is a JSON object
with a key per task.
"""

from __future__ import annotations

import argparse
import functools
import logging
import os
import statistics

os.environ.setdefault("MUJOCO_GL", "disable")

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from tensordict import TensorDict
from torch.nn.functional import one_hot
from torchrl.envs import DMControlWrapper, ParallelEnv
from torchrl.envs.utils import step_mdp

from benchmarks.common import finish, measure, ratio, show
from gdrl_tasks import load, make_task, task_names
from gdrl_tasks.engines.scenery import without_scenery
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.operators.genome import genome_of, install, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

MEMBERS = 11
EPISODES = 20
NETWORKS = {
    True: NetworkConfig(actor_cells=[64, 64], activation="relu"),
    False: NetworkConfig(),
}
"""Those of the experiments, for discrete actions and for continuous ones."""


def evaluator_and_engine(name: str, threads: int, repeats: int) -> list[list[float]]:
    """Rates of the evaluator, of the engine alone and, with actuators, when driven.

    The engine steps all worlds: no forces, no observation, no policy. First the model as
    it is published, then the one without scenery that evaluations step.
    """
    task, worlds = make_task(name), MEMBERS * EPISODES
    spec = task.spec
    env = NavigationEnv(task, worlds, num_threads=threads, seed=0)
    actor, population = make_population(name)
    evaluator = PopulationEvaluator(actor, num_episodes=EPISODES, create_env_fn=lambda: env)
    whole = Batch(mujoco.MjModel.from_xml_string(task.xml()), worlds, threads)
    batch = Batch(without_scenery(task.xml()), worlds, threads)

    def evaluate() -> int:
        return int(evaluator.evaluate(population)["frames"].sum())

    def step_all(batch: Batch) -> int:
        batch.reset()
        for _ in range(spec.step_limit):
            batch.step(nstep=spec.num_substeps)
        return worlds * spec.step_limit

    engines = [functools.partial(step_all, which) for which in (whole, batch)]
    if batch.model.nu == 0:
        rates = measure(evaluate, *engines, repeats=repeats)
        evaluator.close()
        return rates
    control, arrays, ids = batch.bind("ctrl"), task.allocate(worlds), np.arange(worlds)
    choices = np.random.default_rng(0).integers(spec.action_size, size=(50, worlds))
    commands = []
    for choice in choices:
        task.set_action(arrays, ids, choice)
        commands.append(arrays["control"].copy())

    def drive_all() -> int:
        batch.reset()
        for step in range(spec.step_limit):
            control[...] = commands[step % len(commands)]
            batch.step(nstep=spec.num_substeps)
        return worlds * spec.step_limit

    rates = measure(evaluate, *engines, drive_all, repeats=repeats)
    evaluator.close()
    return rates


def dm_control_rate(name: str, repeats: int) -> float:
    """One dm_control environment with zero actions."""
    environment = load(name, random=0)
    spec = environment.action_spec()
    action = np.zeros(spec.shape, spec.dtype)

    def run() -> int:
        steps = 0
        for _ in range(3):
            step = environment.reset()
            while not step.last():
                step = environment.step(action)
                steps += 1
        return steps

    return statistics.median(*measure(run, repeats=repeats))


def wrapped(name: str, seed: int) -> DMControlWrapper:
    """An environment as TorchRL users wrap dm_control ones."""
    return DMControlWrapper(load(name, random=seed))


def parallel_rate(name: str, workers: int, limit: int) -> float:
    """Members one after another over ``ParallelEnv``, episodes spread over workers."""
    task = make_task(name)
    size, is_discrete = task.spec.action_size, task.spec.is_discrete
    makers = [functools.partial(wrapped, name, seed) for seed in range(workers)]
    env = ParallelEnv(workers, makers)
    actor, population = make_population(name)
    names = list(task.spec.observation)

    def run() -> int:
        steps = 0
        for member in range(limit):
            install(actor, population[member])
            for _ in range(-(-EPISODES // workers)):
                td = env.reset()
                alive = torch.ones(workers, dtype=torch.bool)
                while alive.any():
                    observation = torch.cat([td[n] for n in names], dim=-1).float()
                    act = TensorDict(observation=observation, batch_size=[workers])
                    action = actor(act)["action"]
                    # The wrapper's: one-hot choices, or float64 commands.
                    td["action"] = one_hot(action, size) if is_discrete else action.double()
                    if not alive.all():
                        td["_step"] = alive
                    td = env.step(td)
                    steps += int(alive.sum())
                    alive = alive & ~td["next", "done"].squeeze(-1)
                    td = step_mdp(td)
        return steps

    with torch.no_grad():
        rate = statistics.median(*measure(run, repeats=1))
    env.close()
    return rate


def make_population(name: str) -> tuple:
    """A fixed, untrained actor and a population mutated from it."""
    torch.manual_seed(0)
    task = make_task(name)
    config = ExperimentConfig(
        task=task_config_class(name)(),
        algorithm=RainbowConfig() if task.spec.is_discrete else PPOConfig(),
        network=NETWORKS[task.spec.is_discrete],
    )
    actor = make_actor(task, config.network, config.algorithm)
    genomes = stack_copies(genome_of(actor), MEMBERS)
    generator = torch.Generator().manual_seed(0)
    return actor, bernoulli_mutation(genomes, mut_p=0.75, std=0.1, generator=generator)


def main() -> None:
    """Measure every task and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--parallel-members", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    results = {}
    for name in task_names():
        print(f"{name}: control steps per second")
        rates = evaluator_and_engine(name, options.threads, options.repeats)
        evaluator, whole, raw, *driven = map(statistics.median, rates)

        show(f"PopulationEvaluator, {MEMBERS} x {EPISODES}", evaluator)
        show("raw engine, model as published", whole)
        show("raw engine, without scenery", raw)
        if driven:
            show("the same, driven", driven[0])
        single = dm_control_rate(name, options.repeats)
        show("dm_control alone", single)
        best = 0.0
        for workers in (2, EPISODES):
            parallel = parallel_rate(name, workers, options.parallel_members)
            show(f"ParallelEnv, {workers} workers", parallel)
            best = max(best, parallel)
        results[name] = {
            "control_steps_per_s": round(evaluator, 1),
            "ratio_to_raw_engine": ratio(rates[0], rates[1]),
            "ratio_to_engine_without_scenery": ratio(rates[0], rates[2]),
            "ratio_to_torchrl_parallel": round(evaluator / best, 2),
            "raw_engine_steps_per_s": round(whole, 1),
            "engine_without_scenery_steps_per_s": round(raw, 1),
            "dm_control_steps_per_s": round(single, 1),
            "torchrl_parallel_steps_per_s": round(best, 1),
        }
        if driven:
            results[name] |= {
                "ratio_to_driven_engine": ratio(rates[0], rates[3]),
                "driven_engine_steps_per_s": round(driven[0], 1),
            }
    finish(results)


if __name__ == "__main__":
    main()
