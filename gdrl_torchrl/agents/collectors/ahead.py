"""``AheadCollector``: the next batch is collected while the agent learns from this one."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_tasks.engines.divergence import DivergedWorld
from gdrl_torchrl import keys
from gdrl_torchrl.agents.collectors.collects import EnvCollector
from gdrl_torchrl.agents.collectors.finite_batches import check_batch
from gdrl_torchrl.agents.collectors.worker import ForkedWorker, LocalWorker

MakeCollector = Callable[[], EnvCollector]


class AheadCollector:
    """Collects one batch ahead, in a process of its own, for agents that learn off-policy.

    While a trainer learns from a batch, the next one is collected, with the weights that
    the policy had when the trainer got that batch: what acts is one batch behind what
    learns. Which weights those are does not depend on how fast either side is, so a seed
    gives the same result every time, and with ``in_process=False`` too.

    The environment is on the other side, and so are the policy's draws, from a generator
    of their own. TorchRL's collectors in processes hand over batches as they come, with
    whatever weights had arrived, and have no state that a run could go on from.

    Args:
        make_collector: Makes the collector and its environment, on the other side.
        policy: The policy that it acts with; here its weights and buffers change, and
            every batch that is begun takes them along.
        seed: Seed of the policy's draws.
        in_process: Whether to use a process. One that is a daemon may not have any, and
            never does.

    Raises:
        WorkerDiedError: From its methods, if the process is gone.
        NonFiniteBatchError: From them, if an observation or a reward is not finite.

    Examples:
        >>> from gdrl_tasks import make_task
        >>> from gdrl_torchrl.agents.rainbow.network import make_q_actor
        >>> from gdrl_torchrl.envs.navigation import NavigationEnv
        >>> from gdrl_torchrl.agents.collectors.navigation import make_collector
        >>> task = make_task("indoor")
        >>> size = task.spec.observation_size
        >>> actor = make_q_actor(size, task.spec.action_size, value_range=(-1, 1))
        >>> def make():
        ...     env = NavigationEnv(task, num_worlds=2)
        ...     return make_collector(env, actor, frames_per_batch=8, policy_keys=[])
        >>> collector = AheadCollector(make, actor, seed=0)
        >>> next(iter(collector)).batch_size
        torch.Size([2, 4])
        >>> collector.shutdown()
    """

    def __init__(
        self,
        make_collector: MakeCollector,
        policy: TensorDictModuleBase,
        *,
        seed: int,
        in_process: bool = True,
    ) -> None:
        self._policy = policy
        self._on_divergence: Callable[[DivergedWorld], object] | None = None
        self._batch: dict[str, Any] | None = None
        self._is_begun = False
        possible = in_process and not multiprocessing.current_process().daemon
        kind = ForkedWorker if possible else LocalWorker
        self._worker = kind(lambda: _Worlds(make_collector, policy, seed))

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Batches ``[W, T]``, without end."""
        while True:
            yield self.rollout()

    def rollout(self) -> TensorDictBase:
        """The next batch ``[W, T]``; the one after it is begun."""
        if self._waited_for() is None:
            self._begin()
        batch = self._waited_for()
        assert batch is not None
        self._batch = None
        self._begin()
        return _tensordict(batch)

    def watch(self, on_divergence: Callable[[DivergedWorld], object]) -> None:
        """Call a function with every world that diverges, when its batch has come."""
        self._on_divergence = on_divergence

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: the next batch that is begun takes the weights along."""

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """End the process; the batch that is ahead is lost."""
        self._worker.close()

    def state_dict(self) -> dict[str, Any]:
        """The batch that is ahead, and the state of worlds and draws after it."""
        batch = self._waited_for()
        self._worker.begin("get_state")
        return {"batch": batch, "worlds": self._worker.end()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self._waited_for()
        self._worker.begin("set_state", state_dict["worlds"])
        self._worker.end()
        self._batch = state_dict["batch"]

    def _begin(self) -> None:
        self._worker.begin("collect", [x.detach().numpy() for x in _weights(self._policy)])
        self._is_begun = True

    def _waited_for(self) -> dict[str, Any] | None:
        """The batch that is ahead; None if none was begun.

        Raises:
            NonFiniteBatchError: If it has a number that is none, before it gets into a
                state.
        """
        if self._is_begun:
            self._is_begun = False
            batch, diverged = self._worker.end()
            check_batch(_tensordict(batch))
            self._batch = batch
            if self._on_divergence is not None:
                for world in diverged:
                    self._on_divergence(world)
        return self._batch


class _Worlds:
    """The collector and its environment, with a generator of their own."""

    def __init__(
        self, make_collector: MakeCollector, policy: TensorDictModuleBase, seed: int
    ) -> None:
        self._policy = policy
        self._generator = torch.Generator().manual_seed(seed).get_state()
        self._diverged: list[DivergedWorld] = []
        with self._own_draws():
            self._collector = make_collector()
        self._batches = iter(self._collector)
        self._collector.watch(self._diverged.append)

    def collect(self, weights: list[np.ndarray]) -> tuple[dict[str, Any], list[Any]]:
        """A batch, as arrays by name, and the worlds that diverged in it."""
        with self._own_draws():
            for own, given in zip(_weights(self._policy), weights, strict=True):
                own.detach().copy_(torch.from_numpy(given))
            batch = _arrays(next(self._batches))
        diverged = list(self._diverged)
        self._diverged.clear()
        return batch, diverged

    def get_state(self) -> dict[str, Any]:
        """All that the next batch depends on, but weights."""
        return {
            "collector": _arrays(self._collector.state_dict()),
            "generator": self._generator.numpy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Return to a state of :meth:`get_state`."""
        with self._own_draws():
            self._collector.load_state_dict(_tensors(state["collector"]))
            torch.set_rng_state(torch.from_numpy(state["generator"]))

    def close(self) -> None:
        """Close the environment."""
        self._collector.shutdown()

    @contextlib.contextmanager
    def _own_draws(self) -> Iterator[None]:
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._generator)
            yield
            self._generator = torch.get_rng_state()


def _weights(policy: TensorDictModuleBase) -> list[torch.Tensor]:
    return [*policy.parameters(), *policy.buffers()]


def _arrays(entries: Any) -> dict[str, Any]:
    """Tensors as nested arrays: between processes torch sends tensors as open files."""
    return {
        str(name): x.numpy() if isinstance(x, torch.Tensor) else _arrays(x)
        for name, x in entries.items()
    }


def _tensordict(batch: dict[str, Any]) -> TensorDict:
    shape = batch["next"][keys.REWARD].shape[:-1]
    return TensorDict(_tensors(batch), batch_size=shape)


def _tensors(arrays: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _tensors(x) if isinstance(x, dict) else torch.from_numpy(x)
        for name, x in arrays.items()
    }
