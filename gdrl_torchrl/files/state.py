"""States of tensors, arrays and plain values as one file that holds no code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from gdrl_torchrl.files.safe_files import read_content

_MOST_BYTES = 2**30


def write_state(path: Path, state: Any) -> None:
    """Write a state: tensors as safetensors, and where they belong as JSON.

    Args:
        path: The file.
        state: Tensors, arrays, numbers, texts and None in dicts, lists and tuples.

    Raises:
        TypeError: If there is something else in it.
        OSError: If it cannot be written.
    """
    tensors: dict[str, torch.Tensor] = {}
    outline = _outline(state, tensors)
    metadata = {"outline": json.dumps(outline, separators=(",", ":"))}
    # Not by ``save_file``, whose errors do not say what the system said.
    path.write_bytes(save(tensors, metadata))


def read_state(path: Path) -> Any:
    """Read a state of :func:`write_state`. No code of the file is run: it has none.

    Raises:
        ValueError: If the file is not one of those, or has more than a gibibyte.
        OSError: If it cannot be read.
    """
    content = read_content(path, _MOST_BYTES)
    try:
        return state_of(content)
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def state_of(content: bytes) -> Any:
    """The state in the content of a file of :func:`write_state`.

    Raises:
        ValueError: If it is not one.
    """
    try:
        tensors = load(content)
        # The library has checked what comes first: the length of a header in JSON.
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        text = header.get("__metadata__", {}).get("outline", "null")
        return _filled(json.loads(text), tensors)
    # RuntimeError and KeyError: shapes and types that torch has not.
    except (SafetensorError, ValueError, RecursionError, RuntimeError, KeyError) as error:
        raise ValueError(str(error)) from error


def _outline(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """A value without its tensors, which are put beside it, as JSON can hold it.

    Raises:
        TypeError: If there is something that cannot be saved.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (torch.Tensor, np.ndarray, np.generic)):
        name = str(len(tensors))
        # Copies, for the file holds every tensor once, and states may share them.
        tensors[name] = torch.as_tensor(value).detach().cpu().clone().contiguous()
        return {"tensor" if isinstance(value, torch.Tensor) else "array": name}
    if isinstance(value, Mapping):
        items = [[_plain_key(key), _outline(v, tensors)] for key, v in value.items()]
        return {"dict": items}
    if isinstance(value, (list, tuple)):
        kind = "list" if isinstance(value, list) else "tuple"
        return {kind: [_outline(item, tensors) for item in value]}
    raise TypeError(f"{type(value).__name__} {value!r} cannot be saved")


def _plain_key(key: Any) -> str | int:
    if not isinstance(key, (str, int)):
        raise TypeError(f"key {key!r} cannot be saved")
    return key


def _filled(outline: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    """The value of an :func:`_outline`."""
    if outline is None or isinstance(outline, (bool, int, float, str)):
        return outline
    try:
        ((kind, content),) = outline.items()
        if kind == "tensor":
            return tensors[content]
        if kind == "array":
            return tensors[content].numpy()
        if kind == "dict":
            return {key: _filled(item, tensors) for key, item in content}
        items = [_filled(item, tensors) for item in content]
        return {"list": items, "tuple": tuple(items)}[kind]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"the outline of the state is damaged: {error!r}") from error
