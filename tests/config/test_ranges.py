"""Every field has a type and a range, which hold in the class that declares it."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
import re

import pytest

import gdrl_torchrl.config
from gdrl_tasks import task_options
from gdrl_torchrl.agents.registry import ALGORITHMS
from gdrl_torchrl.config.schema import ExperimentConfig
from tests.config.fields import (
    CONFIGS,
    NEEDED,
    PARTS,
    fields_of,
    is_sequence,
    scalars_of,
)

NUMBERS = fields_of(int, float)
NOT_FINITE = (math.nan, math.inf, -math.inf)
NO_NUMBERS = (True, "1", b"1", 1j, {}, object)


def refusal(group, owner, name, value):
    """What is said about a value; it names the field and the value."""
    start = f"{group}.{name}={value!r} must " if group else f"{name}={value!r} must "
    with pytest.raises(ValueError, match=f"^{re.escape(start)}") as refused:
        owner(**{**NEEDED.get(owner, {}), name: value})
    return str(refused.value)


def in_place(owner, name, kind, value):
    """A value as a field's, or as one element of a sequence."""
    if not is_sequence(kind):
        return value
    default = getattr(owner(**NEEDED.get(owner, {})), name)
    changed = [*default[:-1], value]
    return changed if isinstance(default, list) else tuple(changed)


def test_no_configuration_is_forgotten():
    modules = [
        importlib.import_module(f"gdrl_torchrl.config.{module.name}")
        for module in pkgutil.iter_modules(gdrl_torchrl.config.__path__)
    ]
    found = {
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type)
        and dataclasses.is_dataclass(value)
        and value.__module__ == module.__name__
    }
    assert found <= {config for _, config in CONFIGS}
    assert len(NUMBERS) > 80


@pytest.mark.parametrize(("group", "owner", "name", "kind"), NUMBERS)
def test_every_number_has_a_type_and_two_ends(group, owner, name, kind):
    whole = int in scalars_of(kind)
    (field,) = (field for field in dataclasses.fields(owner) if field.name == name)
    bounds = field.metadata["range"]
    outside = [
        bounds.least - 1 if whole else math.nextafter(bounds.least, -math.inf),
        bounds.most + 1 if whole else math.nextafter(bounds.most, math.inf),
        bounds.above,
        bounds.below,
    ]
    ends = [value for value in outside if math.isfinite(value)]
    assert len(ends) == 2
    for value in (*ends, *NOT_FINITE, *NO_NUMBERS, *([2.0] if whole else [])):
        said = refusal(group, owner, name, in_place(owner, name, kind, value))
        assert re.search(r"(>|>=) -?\d\S* and (<|<=) -?\d", said), said


@pytest.mark.parametrize(("group", "owner", "name", "kind"), fields_of(bool, str))
def test_words_and_switches_have_their_type(group, owner, name, kind):
    for value in (1, 0.5, b"calm", []):
        refusal(group, owner, name, in_place(owner, name, kind, value))


def has_choices(owner, name, kind):
    (field,) = (field for field in dataclasses.fields(owner) if field.name == name)
    of_literals = "Literal" in str(kind)
    # The operators that packages may add to are checked by their own names.
    return of_literals or "choices" in field.metadata or name in ("mutation", "crossover")


@pytest.mark.parametrize(
    ("group", "owner", "name", "kind"),
    [field for field in fields_of(str) if has_choices(*field.values[1:])],
)
def test_words_are_among_their_choices(group, owner, name, kind):
    said = refusal(group, owner, name, in_place(owner, name, kind, "sailing"))
    assert "one of [" in said


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_of_its_class(name):
    refusal("", ExperimentConfig, name, {"episodes": 3})


def test_numbers_of_numpy_become_pythons():
    numpy = pytest.importorskip("numpy")
    config = ALGORITHMS["ppo"](num_worlds=numpy.int64(8), gamma=numpy.float32(0.5))
    assert (type(config.num_worlds), type(config.gamma)) == (int, float)
    options = task_options("indoor")(turn_rates_deg_s=numpy.array([-30.0, 30.0]))
    assert options.turn_rates_deg_s == (-30.0, 30.0)
    assert {type(rate) for rate in options.turn_rates_deg_s} == {float}
