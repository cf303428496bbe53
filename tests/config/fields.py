"""Every field of every configuration, and what it is made of."""

from __future__ import annotations

import dataclasses
import re
import typing

import pytest

from gdrl_tasks import task_names, task_options
from gdrl_torchrl.agents.registry import algorithm_configs
from gdrl_torchrl.config.schema import BudgetConfig, ExperimentConfig
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.config.study import Hypothesis, StudyConfig, StudyMethod
from gdrl_torchrl.evolution.settings import EVOLUTIONS


def types_of(owner):
    return typing.get_type_hints(owner)


PARTS = {
    name: kind
    for name, kind in types_of(ExperimentConfig).items()
    if dataclasses.is_dataclass(kind)
}
"""The parts of an experiment that are always the same class, by group."""
CONFIGS = [
    ("", ExperimentConfig),
    ("search", SearchConfig),
    ("study", StudyConfig),
    ("study.methods", StudyMethod),
    ("study.hypotheses", Hypothesis),
    *PARTS.items(),
    *(("algorithm", config) for config in algorithm_configs().values()),
    *(("evolution", config) for config in EVOLUTIONS.values()),
    *(("", task_options(name)) for name in task_names()),
]
NEEDED = {
    SearchConfig: {"params": {"seed": "choice(0, 1)"}},
    StudyConfig: {
        "tasks": {"near": []},
        "methods": {"ppo": StudyMethod(["near"])},
        "total_steps": {"near": 10},
    },
    BudgetConfig: {"agent_steps": 10},
}


def scalars_of(kind):
    """The types that a type is made of."""
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        return {str}
    return set().union(*map(scalars_of, parts)) if parts else {kind}


def is_sequence(kind):
    kinds = {typing.get_origin(kind), *map(typing.get_origin, typing.get_args(kind))}
    return bool(kinds & {list, tuple})


def fields_of(*wanted):
    """Every field of every configuration that is made of one of some types."""
    return [
        pytest.param(group, owner, field.name, kind, id=f"{owner.__name__}.{field.name}")
        for group, owner in CONFIGS
        for field in dataclasses.fields(owner)
        for kind in [types_of(owner)[field.name]]
        if scalars_of(kind) & set(wanted) and typing.get_origin(kind) is not dict
    ]


REFUSAL = re.compile(r"(?:task: )?([a-z_]+(?:\.[a-z_]+)?)=\S.* must .+", re.DOTALL)
"""What an error says: the name of a field, its value and what must be."""
