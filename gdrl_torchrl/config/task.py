"""The config dataclass of a task, derived from the task's own options."""

from __future__ import annotations

import dataclasses
import functools
import re
import types
import typing
from typing import TYPE_CHECKING, Any, Literal

from gdrl_tasks import make_task, task_options
from gdrl_torchrl.checks import check_choice

if TYPE_CHECKING:
    from gdrl_tasks import NavigationTask

BACKENDS = ("batch", "dm_control")


@functools.cache
def task_config_class(name: str) -> type:
    """Make the dataclass of a task's config group: name, backend and every option.

    Types that OmegaConf cannot hold become simpler (a Literal its values' type, a tuple
    a list); the task's own options check the values.

    Examples:
        >>> config = task_config_class("water")(sea="rough")
        >>> make_task_from_config(config).options.sea
        'rough'
    """
    options = task_options(name)
    hints = typing.get_type_hints(options)
    fields: list[Any] = [("name", str, name), ("backend", str, "batch")]
    for field in dataclasses.fields(options):
        simple = _simple_type(hints[field.name])
        default, rules = field.default, _rules(field, hints[field.name])
        if isinstance(default, tuple):
            values = list(default)
            made = dataclasses.field(default_factory=values.copy, metadata=rules)
        else:
            made = dataclasses.field(default=default, metadata=rules)
        fields.append((field.name, simple, made))
    return dataclasses.make_dataclass(f"{name.title()}TaskConfig", fields)


def make_task_from_config(config: Any) -> NavigationTask:
    """Make the task that a config of :func:`task_config_class` describes.

    Raises:
        ValueError: If an option is out of range or ``backend`` unknown.
    """
    check_choice("task.backend", config.backend, BACKENDS)
    options = {
        field.name: getattr(config, field.name)
        for field in dataclasses.fields(config)
        if field.name not in ("name", "backend")
    }
    for name, value in options.items():
        if isinstance(value, list):
            options[name] = tuple(value)
    try:
        return make_task(config.name, **options)
    except ValueError as error:
        # Most begin with an option and its value.
        joint = "." if re.match(r"\w+=", str(error)) else ": "
        raise ValueError(f"task{joint}{error}") from error


def check_fits_policy(trained: NavigationTask, task: NavigationTask, given: str) -> None:
    """Raise ValueError unless a policy that was trained on a task can act in another one.

    Args:
        trained: What it was trained on.
        task: The other one.
        given: What made it so, as it was given.
    """
    for name in ("observation", "action_size", "is_discrete"):
        if getattr(task.spec, name) != getattr(trained.spec, name):
            raise ValueError(
                f"{given}: the policy was trained with {name}="
                f"{getattr(trained.spec, name)}, not {getattr(task.spec, name)}"
            )


def _rules(field: dataclasses.Field[Any], hint: Any) -> dict[str, Any]:
    """What a value may be, and words that its simpler type no longer tells."""
    kinds = [hint, *typing.get_args(hint)]
    words = [typing.get_args(k) for k in kinds if typing.get_origin(k) is Literal]
    return {**field.metadata, **({"choices": words[0]} if words else {})}


def _simple_type(hint: Any) -> Any:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is Literal:
        return type(arguments[0])
    if origin is tuple:
        return list[arguments[0]]
    if origin in (typing.Union, types.UnionType):
        inner = [_simple_type(a) for a in arguments if a is not type(None)]
        return typing.Optional[inner[0]]  # noqa: UP045 - built at run time
    return hint
