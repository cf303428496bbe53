"""Copies of a user's module, and whether the module has changed since."""

from __future__ import annotations

import copy
import io
import pickle
import types
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn

_PLAIN = (bool, int, float, str, type(None))
_EVERY_MODULE_HAS = vars(nn.Module()).keys() - {"training"}


def private_copy(module: nn.Module) -> Any:
    """Copy a module: parameters, buffers and attributes of its own, equally shared.

    What is one parameter or buffer under two names in the module is one in the copy.

    Raises:
        ValueError: If something in the module cannot be copied.

    Examples:
        >>> layer = nn.Linear(3, 2)
        >>> copied = private_copy(layer)
        >>> torch.equal(copied.weight, layer.weight), copied.weight is layer.weight
        (True, False)
    """
    memo: dict[int, Any] = {}
    for part in module.modules():
        # Results of a gradient's graph, as torch's old weight norm keeps: they are made
        # anew at every call, and deepcopy refuses them.
        for value in vars(part).values():
            if isinstance(value, torch.Tensor) and not value.is_leaf:
                memo[id(value)] = value.detach().clone()
    try:
        return copy.deepcopy(module, memo)
    except Exception as error:  # whatever a user's attributes raise
        raise ValueError(
            f"{type(module).__name__} cannot be copied, and members are scored on a copy: "
            f"{error}"
        ) from error


def fingerprint(module: nn.Module) -> bytes | None:
    """All that a module is beside the numbers in its parameters and buffers.

    Modes, attributes, classes, functions, which parameters are shared: two equal
    fingerprints of one module mean that it would do the same with the same numbers, as
    far as its attributes tell. Global variables and those that a function has closed
    over are not seen.

    Returns:
        The fingerprint, or None if an attribute cannot be looked at.

    Examples:
        >>> layer = nn.Dropout(0.5)
        >>> before = fingerprint(layer)
        >>> fingerprint(layer.eval()) == before, fingerprint(layer.train()) == before
        (False, True)
    """
    content = io.BytesIO()
    try:
        _Fingerprint(content, module).dump(module)
    except Exception:  # whatever a user's attributes raise
        return None
    return content.getvalue()


def plain_attributes(modules: Iterable[nn.Module]) -> Callable[[], tuple[Any, ...]]:
    """Make a quick look at modes and other attributes that are numbers or text.

    What a graph of modules depends on, short of a :func:`fingerprint`. Attributes that
    modules get later are not seen.

    Examples:
        >>> layer = nn.Dropout(0.5)
        >>> look = plain_attributes([layer])
        >>> before = look()
        >>> layer.p = 0.1
        >>> look() == before
        False
    """
    watched = [
        (vars(module), name)
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, _PLAIN) and name not in _EVERY_MODULE_HAS
    ]
    # Operators, not methods: this runs before every update.
    return lambda: tuple([x[n] if n in x else None for x, n in watched])  # noqa: SIM401


class _Fingerprint(pickle.Pickler):
    """Pickles a module without the numbers of its parameters and buffers."""

    def __init__(self, file: io.BytesIO, module: nn.Module) -> None:
        super().__init__(file, protocol=5)
        named = (*module.named_parameters(), *module.named_buffers())
        self._names = {id(tensor): name for name, tensor in named}

    def persistent_id(self, obj: Any) -> Any:
        """Stand-ins for what has no content to compare, or a content that is data."""
        if isinstance(obj, torch.Tensor):
            kind = str(obj.dtype), tuple(obj.shape)
            name = self._names.get(id(obj))
            return (*kind, name) if name else (*kind, digest(obj))
        if isinstance(obj, type | types.FunctionType | types.ModuleType):
            return type(obj).__name__, id(obj)
        return None

    def reducer_override(self, obj: Any) -> Any:
        """Modules by their class and attributes, whether or not they can be pickled."""
        if isinstance(obj, nn.Module):
            return list, ((type(obj),),), vars(obj)
        return NotImplemented


def digest(tensor: torch.Tensor) -> int:
    """A number that tells a tensor's content, within this process."""
    values = tensor.detach().cpu().contiguous().reshape(-1)
    return hash(values.view(torch.uint8).numpy().tobytes())
