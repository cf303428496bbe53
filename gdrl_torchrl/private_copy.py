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
    """Copy a module with its parameters, buffers and attributes.

    A parameter or buffer that has two names in the module is also one in the copy.

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
        # Tensors with a history of gradients, as torch's old weight norm keeps them:
        # deepcopy refuses them, and they are made anew at every call.
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
    """Bytes that describe a module without the numbers in its parameters and buffers.

    They cover modes, attributes, classes, functions, and which parameters are shared. If
    two fingerprints of one module are equal, it does the same with the same numbers, as
    far as its attributes show. Global variables and those that a function has closed over
    are not covered.

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
    """Make a quick check of modes and other attributes that are numbers or text.

    These are most of what a graph of modules depends on; a :func:`fingerprint` covers
    more. Attributes that modules get later are not seen.

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
    # Operators are faster than methods, and this runs before every update.
    return lambda: tuple([x[n] if n in x else None for x, n in watched])  # noqa: SIM401


class _Fingerprint(pickle.Pickler):
    """Pickles a module without the numbers of its parameters and buffers."""

    def __init__(self, file: io.BytesIO, module: nn.Module) -> None:
        super().__init__(file, protocol=5)
        named = (*module.named_parameters(), *module.named_buffers())
        self._names = {id(tensor): name for name, tensor in named}

    def persistent_id(self, obj: Any) -> Any:
        """Stand-ins for tensors, and for objects that are compared by identity."""
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
    """A number that differs with a tensor's content, valid within this process."""
    values = tensor.detach().cpu().contiguous().reshape(-1)
    return hash(values.view(torch.uint8).numpy().tobytes())
