"""What a step costs, in facts that do not depend on the machine: calls and operations.

Figures are those of today, with a little room. Whoever exceeds one has put work on a hot
path, and measures with ``benchmarks`` whether it is worth it.
"""

import subprocess
import sys
import tracemalloc

import pytest
import torch

from gdrl_tasks import make_task, simulate
from gdrl_torchrl.agents.rainbow.replay import draw_minibatch
from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import seed_everything

EXPERIMENTS = {"indoor": "grainbow_indoor", "water": "gppo_water"}


def calls_of(run):
    """Calls of Python and of C functions while something runs."""
    count = 0

    def note(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    return count


@pytest.fixture(params=EXPERIMENTS)
def training(request):
    config = load_experiment(
        [
            f"experiment={EXPERIMENTS[request.param]}",
            "simulation.num_threads=1",
            "algorithm.num_worlds=4",
            "algorithm.frames_per_batch=256",
            "algorithm.minibatch_size=64",
        ]
        + ["algorithm.warmup_steps=64", "algorithm.collect_ahead=false"]
        * (request.param == "indoor")
    )
    seed_everything(0)
    made = build_training(config)
    yield made
    made.close()


def test_calls_per_step_of_collection(training):
    name = training.task.name
    batches = iter(training.agent.collector)
    for _ in range(2):
        next(batches)
    # Episodes that end are drawn anew, which is not a step's cost.
    per_step = calls_of(lambda: next(batches)) / 64
    assert per_step < {"indoor": 220, "water": 390}[name]


def test_operations_of_an_acting_policy(training):
    next(iter(training.agent.collector))
    [graph] = training.agent.collector.traced_policy.graphs.values()
    assert graph.num_operations <= {"indoor": 19, "water": 25}[training.task.name]


def test_operations_and_calls_of_an_update(training):
    learner = training.agent.learner
    batch = next(iter(training.agent.collector))
    if training.task.name == "indoor":
        learner.store(batch)
    minibatches = iter(() if training.task.name == "indoor" else learner.minibatches(batch))

    def update():
        if training.task.name == "indoor":
            learner.step(draw_minibatch(learner.buffer))
        else:
            learner.update(next(minibatches))

    for _ in range(2):
        update()
    [graph] = learner.update.traced_loss.graphs
    assert graph.num_operations <= {"indoor": 140, "water": 130}[training.task.name]
    assert calls_of(update) < {"indoor": 1500, "water": 900}[training.task.name]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_calls_per_step_of_an_evaluation_do_not_grow_with_the_population(name):
    def calls(members):
        config = load_experiment([f"experiment={EXPERIMENTS[name]}"])
        task = make_task(name, step_limit=30)
        torch.manual_seed(0)
        actor = make_actor(task, config.network, config.algorithm)
        evaluator = PopulationEvaluator(
            actor,
            num_episodes=2,
            create_env_fn=lambda: NavigationEnv(task, 2 * members, num_threads=1, seed=0),
        )
        population = stack_copies(genome_of(actor), members)
        seeds = torch.arange(2)
        evaluator.evaluate(population, seeds=seeds)
        count = calls_of(lambda: evaluator.evaluate(population, seeds=seeds))
        evaluator.close()
        return count

    assert calls(60) < 1.2 * calls(20)


def test_memory_of_an_evaluation_does_not_grow_with_steps():
    def peak(limit):
        task = make_task("water", step_limit=limit)
        config = load_experiment(["experiment=gppo_water"])
        actor = make_actor(task, config.network, config.algorithm)
        evaluator = PopulationEvaluator(
            actor,
            num_episodes=4,
            create_env_fn=lambda: NavigationEnv(task, 16, num_threads=1, seed=0),
        )
        population = stack_copies(genome_of(actor), 4)
        # The same episodes twice: what is traced once for a shape is there by then.
        seeds = torch.arange(4)
        evaluator.evaluate(population, seeds=seeds)
        tracemalloc.start()
        evaluator.evaluate(population, seeds=seeds)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        evaluator.close()
        return most

    assert peak(120) < 1.2 * peak(40) + 10_000


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_calls_per_step_of_a_simulation_do_not_grow_with_worlds(name):
    def calls(worlds):
        simulation = simulate(name, num_worlds=worlds, num_threads=1, seed=0)
        simulation.reset()
        spec = simulation.task.spec
        action = torch.zeros(worlds, dtype=torch.int64).numpy()
        if not spec.is_discrete:
            action = torch.zeros(worlds, spec.action_size).numpy()
        simulation.step(action)
        return calls_of(lambda: simulation.step(action))

    assert calls(50) == calls(5)


def test_help_imports_no_torch():
    code = (
        "import sys; sys.argv = ['gdrl-train', '--help']\n"
        "from gdrl_torchrl.cli.train import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "heavy = {'torch', 'torchrl', 'matplotlib', 'dm_control'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "experiment" in done.stdout
