"""What a run asks of a collector, and TorchRL's collector made so."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Protocol

from tensordict import TensorDictBase
from torchrl.collectors import Collector

from gdrl_tasks.engines.divergence import DivergedWorld


class Collects(Protocol):
    """Steps worlds and gives their batches, and can go on exactly from a state."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Batches ``[W, T]``, without end."""
        ...

    def watch(self, on_divergence: Callable[[DivergedWorld], object]) -> None:
        """Call a function with every world that diverges."""
        ...

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Take over the policy's weights, where it acts with a copy."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that the next batch depends on, but weights and torch's own generator."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        ...

    def shutdown(self) -> None:
        """Close the worlds; a second call does nothing."""
        ...


class EnvCollector(Collector):
    """TorchRL's collector with a state: that of its worlds.

    TorchRL's own is that of policy and transforms, from which no run could go on exactly.

    Args:
        create_env_fn: The environment of :func:`~gdrl_torchrl.envs.make.make_env`.
        policy: What acts.
        **options: As of :class:`torchrl.collectors.Collector`.
    """

    env: Any

    def watch(self, on_divergence: Callable[[DivergedWorld], object]) -> None:
        """Call a function with every world that diverges."""
        self.env.watch(on_divergence)

    def state_dict(self) -> dict[str, Any]:
        """The worlds, as the environment's ``get_state`` gives them."""
        return {"env": self.env.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any], **kwargs: Any) -> None:
        """Return to a state of :meth:`state_dict`.

        Begins no episodes that go on; torch's generator may be drawn from.
        """
        self.env.set_state(state_dict["env"])
        # The environment goes on from its state; the collector reads where that is.
        self.reset()
