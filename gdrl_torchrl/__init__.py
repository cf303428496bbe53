"""Genetic Deep Reinforcement Learning as a kit of TorchRL components.

What is here by name is the API; it is imported when it is used.

>>> import gdrl_torchrl
>>> gdrl_torchrl.PopulationEvaluator.__module__
'gdrl_torchrl.evolution.population.evaluator'
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

if "OpenGL" in sys.modules or "glfw" in sys.modules:
    # tensordict loads Triton, which must be made ready for a Mesa that came first.
    from gdrl_tasks.engines.opengl import load_triton

    load_triton()

if TYPE_CHECKING:
    from gdrl_torchrl.agents.networks import (
        make_argmax_actor,
        make_tanh_normal_actor,
        make_value_network,
    )
    from gdrl_torchrl.agents.ppo.loss import make_ppo_loss
    from gdrl_torchrl.agents.rainbow.loss import RainbowLoss
    from gdrl_torchrl.agents.rainbow.network import make_q_actor
    from gdrl_torchrl.envs.make import make_env
    from gdrl_torchrl.envs.navigation import NavigationEnv
    from gdrl_torchrl.evolution.hooks.attach import AttachedGeneticHook
    from gdrl_torchrl.evolution.hooks.breeding import Breeding, MutatedChildren
    from gdrl_torchrl.evolution.hooks.contest import (
        Contest,
        CopiesContest,
        FullContest,
        PairedContest,
        RandomContest,
    )
    from gdrl_torchrl.evolution.hooks.erl import ErlHook
    from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
    from gdrl_torchrl.evolution.hooks.genetic_algorithm import GeneticAlgorithm
    from gdrl_torchrl.evolution.hooks.hand_over import HandOver
    from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
    from gdrl_torchrl.evolution.operators.crossover import mean_crossover, n_point_crossover
    from gdrl_torchrl.evolution.operators.genome import (
        concatenate,
        genome_of,
        install,
        stack_copies,
    )
    from gdrl_torchrl.evolution.operators.mutation import (
        bernoulli_mutation,
        pseudocode_mutation,
        scaled_mutation,
    )
    from gdrl_torchrl.evolution.operators.paired import HalvingPlan
    from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
    from gdrl_torchrl.evolution.operators.selection import select_best
    from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
    from gdrl_torchrl.evolution.race.attach import AttachedRaceHook
    from gdrl_torchrl.evolution.race.hook import RaceHook
    from gdrl_torchrl.evolution.settings import RaceConfig
    from gdrl_torchrl.files.policy import load_policy, params_sha256, save_policy

# torch and TorchRL take seconds to import.
_WHERE = {
    "agents.networks": (
        "make_argmax_actor",
        "make_tanh_normal_actor",
        "make_value_network",
    ),
    "agents.rainbow.loss": ("RainbowLoss",),
    "agents.rainbow.network": ("make_q_actor",),
    "agents.ppo.loss": ("make_ppo_loss",),
    "envs.make": ("make_env",),
    "envs.navigation": ("NavigationEnv",),
    "evolution.hooks.attach": ("AttachedGeneticHook",),
    "evolution.hooks.breeding": (
        "Breeding",
        "MutatedChildren",
    ),
    "evolution.hooks.contest": (
        "Contest",
        "CopiesContest",
        "FullContest",
        "PairedContest",
        "RandomContest",
    ),
    "evolution.hooks.erl": ("ErlHook",),
    "evolution.hooks.genetic": ("GeneticHook",),
    "evolution.hooks.genetic_algorithm": ("GeneticAlgorithm",),
    "evolution.hooks.hand_over": ("HandOver",),
    "evolution.hooks.watch": ("EpisodeWatch",),
    "evolution.operators.crossover": (
        "mean_crossover",
        "n_point_crossover",
    ),
    "evolution.operators.genome": (
        "concatenate",
        "genome_of",
        "install",
        "stack_copies",
    ),
    "evolution.operators.mutation": (
        "bernoulli_mutation",
        "pseudocode_mutation",
        "scaled_mutation",
    ),
    "evolution.operators.paired": ("HalvingPlan",),
    "evolution.operators.schedule": ("MutationSchedule",),
    "evolution.operators.selection": ("select_best",),
    "evolution.population.evaluator": ("PopulationEvaluator",),
    "evolution.race.attach": ("AttachedRaceHook",),
    "evolution.race.hook": ("RaceHook",),
    "evolution.settings": ("RaceConfig",),
    "files.policy": (
        "load_policy",
        "params_sha256",
        "save_policy",
    ),
}
_LAZY = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [
    "AttachedGeneticHook",
    "AttachedRaceHook",
    "Breeding",
    "Contest",
    "CopiesContest",
    "EpisodeWatch",
    "ErlHook",
    "FullContest",
    "GeneticAlgorithm",
    "GeneticHook",
    "HalvingPlan",
    "HandOver",
    "MutatedChildren",
    "MutationSchedule",
    "NavigationEnv",
    "PairedContest",
    "PopulationEvaluator",
    "RaceConfig",
    "RaceHook",
    "RainbowLoss",
    "RandomContest",
    "bernoulli_mutation",
    "concatenate",
    "genome_of",
    "install",
    "load_policy",
    "make_argmax_actor",
    "make_env",
    "make_ppo_loss",
    "make_q_actor",
    "make_tanh_normal_actor",
    "make_value_network",
    "mean_crossover",
    "n_point_crossover",
    "params_sha256",
    "pseudocode_mutation",
    "save_policy",
    "scaled_mutation",
    "select_best",
    "stack_copies",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_LAZY[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
