"""Recording of operations on tensors while torch runs them."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import fx
from torch.fx.node import map_aggregate
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

Tensors = list[torch.Tensor]
IS_RANDOM = "draws random numbers"
"""Key of a node's metadata, for targets that do not say it."""
_TO_PYTHON = (
    torch.Tensor.numpy,
    torch.Tensor.tolist,
    torch.Tensor.__array__,
    torch.Tensor.__dlpack__,
)
"""Methods that take numbers out of torch without an operation."""


class Recorder(TorchDispatchMode):
    """Notes the operations on tensors that torch runs while it is entered.

    Torch's ``make_fx`` does the same, but also computes the result of each operation for
    tensors without numbers, which takes most of its time and is not needed here.
    Operations are noted below autograd and ``torch.vmap``, so the operations that these
    two run are noted too.

    Args:
        tensors: Arguments of the function that is noted. Other tensors that it uses are
            constants of the graph: their numbers are not copied.

    Raises:
        ValueError: If an operation makes a Python number of tensors that depend on the
            given ones or on random draws, or makes an array or a list of any tensor.

    Examples:
        >>> tensors = [torch.ones(2), torch.ones(2)]
        >>> with Recorder(tensors) as recorder:
        ...     total = (tensors[0] * tensors[1]).sum()
        >>> whole = recorder.whole([total])
        >>> whole(torch.ones(2), torch.tensor([3.0, 4.0]))
        (tensor(7.),)
    """

    def __init__(self, tensors: Tensors) -> None:
        super().__init__()
        self._graph = fx.Graph()
        self._constants: dict[str, torch.Tensor] = {}
        # Tensors are identified by their id, so each is kept alive.
        self._noted: dict[int, tuple[torch.Tensor, fx.Node]] = {}
        # Nodes whose numbers do not depend on the given tensors.
        self._fixed: set[fx.Node] = set()
        for i, tensor in enumerate(tensors):
            self._note(tensor, self._graph.placeholder(f"tensor_{i}"))
        self._guard = _StayInTorch()

    def __enter__(self) -> Self:
        self._guard.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._guard.__exit__(*error)

    def whole(self, outputs: Sequence[torch.Tensor]) -> fx.GraphModule:
        """The function of the given tensors that returned ``outputs``, as a graph."""
        self._graph.output(self._nodes(tuple(outputs)))
        return fx.GraphModule(self._constants, self._graph)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        node = self._graph.call_function(func, self._nodes(args), self._nodes(kwargs or {}))
        if mutates(node):
            self._fixed.clear()  # the node may have written into any of them
        elif self._fixed.issuperset(node.all_input_nodes) and not is_random(node):
            self._fixed.add(node)
        elif torch.Tag.data_dependent_output in func.tags:
            raise ValueError(f"{func} looks at numbers")
        if func is torch.ops.aten.detach.default:
            # A graph is run without gradients, so there is nothing to detach.
            self._noted[id(result)] = result, node.all_input_nodes[0]
        else:
            self._note(result, node)
        return result

    def _nodes(self, values: Any) -> Any:
        return map_aggregate(
            values, lambda x: self._node(x) if isinstance(x, torch.Tensor) else x
        )

    def _node(self, tensor: torch.Tensor) -> fx.Node:
        if id(tensor) not in self._noted:
            name = f"constant_{len(self._constants)}"
            self._constants[name] = tensor
            self._note(tensor, self._graph.create_node("get_attr", name))
            self._fixed.add(self._noted[id(tensor)][1])
        return self._noted[id(tensor)][1]

    def _note(self, result: Any, node: fx.Node) -> None:
        if isinstance(result, torch.Tensor):
            self._noted[id(result)] = result, node
        elif isinstance(result, list | tuple):
            for i, each in enumerate(result):
                one = self._graph.call_function(operator.getitem, (node, i))
                if node in self._fixed:
                    self._fixed.add(one)
                self._note(each, one)


class _StayInTorch(TorchFunctionMode):
    """Refuses methods that take numbers out of torch, since no operation shows them."""

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        if func in _TO_PYTHON:
            raise ValueError(f"Tensor.{func.__name__} looks at numbers")
        return func(*args, **(kwargs or {}))


def is_random(node: fx.Node) -> bool:
    """Whether an operation draws random numbers."""
    tags = getattr(node.target, "tags", ())
    return node.meta.get(IS_RANDOM, torch.Tag.nondeterministic_seeded in tags)


def mutates(node: fx.Node) -> bool:
    """Whether an operation writes into one of its arguments."""
    schema = getattr(node.target, "_schema", None)
    return schema is not None and schema.is_mutable
