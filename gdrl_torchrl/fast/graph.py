"""Functions of tensors as graphs: traced once, then run with little Python between."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import fx
from torch.fx.node import map_arg

from gdrl_torchrl.fast.recorder import IS_RANDOM, Recorder, Tensors, is_random, mutates

_logger = logging.getLogger(__name__)

_NEW_MEMORY = (torch.ops.aten.empty.memory_format, torch.ops.aten.empty_like.default)
_PLAIN_NAMES = {"split": "unsafe_split", "_unsafe_view": "view", "_to_copy": "to"}
"""Functions for operators that have no quick function of their own name."""
_PRODUCTS = (torch.ops.aten.mul.Scalar, torch.ops.aten.mul.Tensor)


class TracedFunction:
    """A function ``(constants, inputs) -> outputs`` of lists of tensors, as a graph.

    Operations that change nothing (a view of the same shape, a product with 1) are left
    out, and those that depend on nothing but the constants are run once, when the
    constants are given. What remains gives the same numbers as the function, bit for
    bit, for tensors of the shapes that it was traced with.

    Args:
        function: Called once, with the tensors below. Which operations it runs must not
            depend on their numbers.
        constants: Tensors that change seldom.
        inputs: Tensors that change at every call.

    Raises:
        Exception: What ``function`` raises when it is traced.

    Examples:
        >>> def line(constants, inputs):
        ...     return [constants[0].exp() * inputs[0] * 1]
        >>> zero, ones = torch.zeros(2), torch.ones(2)
        >>> traced = TracedFunction(line, [zero], [ones])
        >>> traced.run(traced.prepare([zero]), [3 * ones])
        (tensor([3., 3.]),)
        >>> traced.num_operations
        1
    """

    def __init__(
        self,
        function: Callable[[Tensors, Tensors], Sequence[torch.Tensor]],
        constants: Tensors,
        inputs: Tensors,
    ) -> None:
        tensors = [*constants, *inputs]
        with Recorder(tensors) as recorder:
            outputs = function(constants, inputs)
        whole = recorder.whole(outputs)
        whole.graph.eliminate_dead_code()
        # The graph runs without gradients: a function that needs gradients computes them
        # itself, and the operations of that are in the graph.
        with torch.no_grad():
            if not any(_writes(node) for node in whole.graph.nodes):
                _Identities(whole).run(*tensors)
                _merge_equal_nodes(whole.graph)
                _PlainFunctions(whole).run(*tensors)
        whole.graph.eliminate_dead_code()
        nodes = list(whole.graph.nodes)
        self.is_pure = not any(is_random(node) or _writes(node) for node in nodes)
        """Whether it neither draws numbers nor writes into memory that others may read."""
        self._before, self._after = _split(whole, len(constants))
        self.num_operations = sum(
            node.op == "call_function" and "getitem" not in str(node.target)
            for node in self._after.graph.nodes
        )

    @torch.no_grad()
    def prepare(self, constants: Tensors) -> Tensors:
        """Compute what :meth:`run` needs of the constants."""
        return list(self._before.forward(*constants))

    @torch.no_grad()
    def run(self, prepared: Tensors, inputs: Tensors) -> tuple[torch.Tensor, ...]:
        """The function's outputs for inputs and prepared constants."""
        # Calling the module would look for hooks, which takes time.
        return self._after.forward(*prepared, *inputs)

    def bind(self, constants: Tensors) -> Callable[..., tuple[torch.Tensor, ...]]:
        """The function of the inputs alone, one by one, until the constants change."""
        # Detached, so that no run needs to switch gradients off.
        prepared = [tensor.detach() for tensor in self.prepare(constants)]
        return functools.partial(self._after.forward, *prepared)


def trace(
    function: Callable[[Tensors, Tensors], Sequence[torch.Tensor]],
    constants: Tensors,
    inputs: Tensors,
) -> TracedFunction | None:
    """Trace a function, if its graph gives the same numbers bit for bit.

    If the function draws from torch's global generator, so does the graph, and it gives
    the same numbers for the same state. Tracing leaves that state unchanged.

    Args:
        function: As in :class:`TracedFunction`. It may also use tensors that are not
            among its arguments; these are constants of the graph.
        constants: Tensors that change seldom.
        inputs: Tensors that change at every call.

    Returns:
        The graph, or None if the function reads numbers of tensors, is random in another
        way or cannot be traced for other reasons, which are logged.

    Examples:
        >>> zero, ones = torch.zeros(2), torch.ones(2)
        >>> trace(lambda constants, inputs: [constants[0] + inputs[0]], [zero], [ones])
        <gdrl_torchrl.fast.graph.TracedFunction object at ...>
        >>> trace(lambda constants, inputs: [ones * inputs[0].item()], [], [zero[:1]])
    """
    state = torch.get_rng_state()
    try:
        expected = function(constants, inputs)
        torch.set_rng_state(state)
        graph = TracedFunction(function, constants, inputs)
        torch.set_rng_state(state)
        outputs = graph.run(graph.prepare(constants), inputs)
    except Exception as error:  # whatever a module of a user raises when traced
        _logger.debug("%s is not traced: %s", function, error)
        return None
    finally:
        torch.set_rng_state(state)
    if all(map(_are_equal, outputs, expected)):
        return graph
    _logger.debug("%s is not traced: its graph gives other numbers", function)
    return None


class _Identities(fx.Interpreter):
    """Replaces operations that only give an existing tensor again by that tensor."""

    def __init__(self, whole: fx.GraphModule) -> None:
        # Tensors are identified by their memory, so none may be freed.
        super().__init__(whole, garbage_collect_values=False)
        self._first: dict[Any, fx.Node] = {}

    def run_node(self, n: fx.Node) -> Any:
        result = super().run_node(n)
        if not isinstance(result, torch.Tensor) or mutates(n):
            return result
        first = self._first.setdefault(_place(result), n)
        if n.target in _PRODUCTS and not isinstance(n.args[1], fx.Node):
            factor, number = n.args
            is_one = number == 1 and isinstance(factor, fx.Node)
            if is_one and _layout(self.env[factor]) == _layout(result):  # pyright: ignore
                first = factor
        if first is not n and n.op == "call_function":
            n.replace_all_uses_with(first)  # pyright: ignore[reportArgumentType]
        return result


class _PlainFunctions(fx.Interpreter):
    """Replaces operators by torch's functions of the same name, which are called faster.

    Only where a function gives the same numbers and leaves torch's generator in the same
    state.
    """

    def run_node(self, n: fx.Node) -> Any:
        before = torch.get_rng_state()
        result = super().run_node(n)
        schema: Any = getattr(n.target, "_schema", None)
        # Uninitialised memory may be equal by chance; an operation that writes into a
        # tensor would write twice if it were tried here.
        if schema is None or n.target in _NEW_MEMORY or mutates(n):
            return result
        after = torch.get_rng_state()
        name = str(schema.name).partition("::")[2]
        args, kwargs = self.fetch_args_kwargs_from_env(n)
        for owner in (torch, torch.Tensor):
            torch.set_rng_state(before)
            try:
                function: Any = getattr(owner, _PLAIN_NAMES.get(name, name))
                other = function(*args, **kwargs)
            except (AttributeError, TypeError, RuntimeError):
                continue
            if torch.equal(torch.get_rng_state(), after) and _are_alike(other, result):
                n.meta[IS_RANDOM] = is_random(n)  # the function does not say so
                n.target = function
                break
        torch.set_rng_state(after)
        return result


def _merge_equal_nodes(graph: fx.Graph) -> None:
    """Merge operations that compute the same from the same tensors."""
    known: dict[Any, fx.Node] = {}
    for node in list(graph.nodes):
        if node.op != "call_function" or is_random(node) or mutates(node):
            continue
        if any(mutates(user) for user in node.users):
            continue
        first = known.setdefault(repr((node.target, node.args, node.kwargs)), node)
        if first is not node:
            node.replace_all_uses_with(first)
            graph.erase_node(node)


def _are_equal(one: torch.Tensor, other: torch.Tensor) -> bool:
    return torch.equal(one.nan_to_num(), other.nan_to_num())


def _are_alike(one: Any, other: Any) -> bool:
    """Whether results, tensors or lists of them, are equal and laid out alike."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return _layout(one) == _layout(other) and _are_equal(one, other)
    both = isinstance(one, list | tuple) and isinstance(other, list | tuple)
    return both and len(one) == len(other) and all(map(_are_alike, one, other))


def _layout(tensor: torch.Tensor) -> tuple[Any, ...]:
    flags = tensor.is_conj(), tensor.is_neg()
    return tensor.dtype, tensor.shape, tensor.stride(), flags


def _place(tensor: torch.Tensor) -> tuple[Any, ...]:
    memory = tensor.untyped_storage().data_ptr()
    return memory, tensor.data_ptr(), *_layout(tensor)


def _writes(node: fx.Node) -> bool:
    """Whether a node writes into memory that others may read, not only into new memory."""
    if not mutates(node):
        return False
    place = node.args[0]
    is_new = isinstance(place, fx.Node) and place.target in _NEW_MEMORY
    return not (is_new and len(place.users) == 1)  # pyright: ignore


def _split(whole: fx.GraphModule, count: int) -> tuple[fx.GraphModule, fx.GraphModule]:
    """The part that depends on the first ``count`` arguments alone, and the rest."""
    before, after = fx.Graph(), fx.Graph()
    nodes = list(whole.graph.nodes)
    placeholders = [node for node in nodes if node.op == "placeholder"]
    varying = set(placeholders[count:])
    # Memory that a run writes into must be made anew for the next run.
    all_vary = any(_writes(node) for node in nodes)
    for node in nodes:
        varies = is_random(node) or varying.intersection(node.all_input_nodes)
        varies = varies or any(mutates(user) for user in node.users)
        if varies or (all_vary and node.op == "call_function"):
            varying.add(node)
    early: dict[fx.Node, fx.Node] = {}
    for node in nodes:
        if node not in varying and node.op != "output":
            early[node] = before.node_copy(node, early.__getitem__)
    needed = [
        node
        for node in early
        if any(user in varying or user.op == "output" for user in node.users)
    ]
    before.output(tuple(early[node] for node in needed))
    late = {node: after.placeholder(node.name) for node in needed}
    for node in nodes:
        if node in varying and node.op != "output":
            late[node] = after.node_copy(node, late.__getitem__)
    output = nodes[-1]
    after.output(map_arg(output.args[0], late.__getitem__))
    return fx.GraphModule(whole, before), fx.GraphModule(whole, after)
