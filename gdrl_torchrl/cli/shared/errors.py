"""What users are told of mistakes: one line, with the option, its value and what to do."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    OmegaConfBaseException,
    ValidationError,
)
from yaml import YAMLError

from gdrl_torchrl.cli.shared.arguments import one_line, printable
from gdrl_torchrl.cli.shared.names import names_in
from gdrl_torchrl.config.options import nearest, unknown_option, wrong_type

_GIVEN = "must be name=value"


def wants_traceback() -> bool:
    """Whether a user has asked for tracebacks, as Hydra's users do."""
    return os.environ.get("HYDRA_FULL_ERROR") == "1"


@contextmanager
def explained(overrides: Sequence[str]) -> Iterator[None]:
    """Turn errors of what reads overrides into a ValueError with one plain line.

    Args:
        overrides: What was given on the command line.

    Raises:
        ValueError: Instead of the errors of Hydra, OmegaConf and YAML.
    """
    try:
        yield
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ValueError(explanation(error, overrides)) from error
    except ValueError as error:
        if "Config group override must be" not in str(error):
            raise
        raise ValueError(_no_file(overrides)) from error


def explanation(error: Exception, overrides: Sequence[str]) -> str:
    """What an error of Hydra, OmegaConf or YAML means, in one line."""
    text = _first_line(error)
    if isinstance(error, MissingConfigException):
        return _missing_file(error, text)
    if isinstance(error, OverrideParseException):
        return _no_override(error.override, text)
    if isinstance(error, YAMLError):
        return f"{' '.join(overrides)} {_GIVEN}: no YAML: {one_line(error)}"
    if found := re.search(r"Ambiguous value for argument '(.+)'", text):
        return (
            f"{found[1]} must be one value: -m runs each of several, and a list is "
            "written name=[a,b]"
        )
    if found := re.search(r"Could not override '([^']+)'\. No match in the defaults", text):
        name = found[1]
        return _not_in_defaults(name, overrides)
    if found := re.match(r"(\S+) appears more than once in the final defaults", text):
        return f"+{_given(found[1], overrides)} must be given once, without +"
    if found := re.search(
        r"(?s)In '([^']+)/(\w+)': ConfigKeyError.*full_key: (\S+)", str(error)
    ):
        return (
            f"{found[1]}={found[2]} must go with what else is chosen: it sets {found[3]}, "
            "which is no option of that"
        )
    return _of_the_cause(error, text, overrides)


_ALSO_TAKEN = ("hydra.launcher.max_num_timeout",)
"""What launchers take that their dataclasses lack: how often submitit queues again."""


def check_known(config: DictConfig, section: str = "") -> None:
    """Raise ValueError if a configuration has options that its dataclasses do not.

    OmegaConf takes such ones where they are written with ``+``.
    """
    owner = OmegaConf.get_type(config)
    known = getattr(owner, "__dataclass_fields__", None)
    for key in config:
        name = f"{section}.{key}".lstrip(".")
        if name == "hydra":
            continue  # see check_known_to_hydra
        node = config._get_node(key)
        if known is not None and key not in known and name not in _ALSO_TAKEN:
            value = node if isinstance(node, DictConfig) else config[key]
            raise ValueError(unknown_option(f"+{name}={value}", name, owner))
        if isinstance(node, DictConfig) and not node._is_none():
            check_known(node, name)


def check_known_to_hydra(config: DictConfig) -> None:
    """The same of Hydra's part of a configuration, where it is a user's."""
    for section in ("job", "launcher", "run", "sweep", "sweeper"):
        check_known(config[section], f"hydra.{section}")


def _of_the_cause(error: Exception, text: str, overrides: Sequence[str]) -> str:
    cause = error.__cause__ if isinstance(error, HydraException) else error
    if not isinstance(cause, OmegaConfBaseException) or not cause.full_key:
        return text
    name = cause.full_key
    given = _given(name, overrides)
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError)):
        if cause.object_type is dict:
            return f"{given} must be written +{given}, which adds it"
        return unknown_option(given, name, cause.object_type)
    if isinstance(cause, ValidationError):
        return wrong_type(given, name, cause.object_type)
    return f"{given}: {_first_line(cause)}"


def _missing_file(error: MissingConfigException, text: str) -> str:
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    names = names_in(group)
    if not names:
        return text
    return not_among(group, name, names)


def not_among(group: str, name: str, names: Sequence[str]) -> str:
    """What is said of a file of ``conf/`` that does not exist."""
    near = nearest(name, names)
    if near is not None:
        return f"{group}={name} must be one that exists: did you mean {group}={near}?"
    return f"{group}={name} must be one of {', '.join(names)}"


def _no_override(override: str, text: str) -> str:
    if "missing EQUAL" in text or "=" not in override:
        near = nearest(override, names_in("experiment"))
        example = f"experiment={near}" if near else "seed=1"
        return f"{override!r} {_GIVEN}, such as {example}"
    return (
        f"{override!r} {_GIVEN} ({text.partition(': ')[2] or text}): quote a value with "
        "spaces, brackets or other signs, such as name='a b'"
    )


def _not_in_defaults(name: str, overrides: Sequence[str]) -> str:
    given = _given(name, overrides)
    if names_in(name):
        with_m = ", after -m" if name == "sweep" else ""
        return f"{given} must be written +{given}{with_m}"
    return unknown_option(given, name)


def _no_file(overrides: Sequence[str]) -> str:
    """What is said where a group is given a number or nothing instead of a name."""
    for override in overrides:
        group, _, value = override.partition("=")
        if (names := names_in(group)) and value not in names:
            return not_among(group, value, names)
    return f"{' '.join(overrides)} {_GIVEN}"


def _given(name: str, overrides: Sequence[str]) -> str:
    """The last override of an option, or of what is below it, as it was written."""
    plain = re.sub(r"\[\d+\]$", "", name)
    for override in reversed(overrides):
        key = override.lstrip("+~").partition("=")[0].partition("@")[0]
        if key == plain or key.startswith(f"{plain}."):
            return override.lstrip("+~")
    return plain


def _first_line(error: BaseException) -> str:
    return printable(str(error).strip().partition("\n")[0])
