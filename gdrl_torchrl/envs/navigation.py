"""Navigation tasks as a natively batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from gdrl_tasks import BatchSimulation, NavigationTask, Outcome
from gdrl_tasks.engines.divergence import DivergedWorld
from gdrl_tasks.seeds import fresh_seed
from gdrl_torchrl import keys
from gdrl_torchrl.envs.record import RECORDED, make_entries


class NavigationEnv(EnvBase):
    """``W`` worlds of a task as one environment of batch size ``[W]``.

    Observations and rewards are float32. A ``_reset`` mask begins new episodes in some
    worlds only; a ``_step`` mask advances some worlds only, and the others cost
    nothing. ``reset(episode_seed=seeds)`` chooses the episodes, int64 ``[W]``.

    Beside TorchRL's keys every tensordict holds, each ``[W, 1]``: ``success`` (bool),
    ``outcome`` (:class:`gdrl_tasks.Outcome`), ``episode_number`` (in the order in which
    episodes began), ``episode_seed`` and ``episode_steps`` (int64), ``time_left`` (share
    of the step limit, for critics), ``episode_return``, ``path_length`` and
    ``shortest_path`` (metres).

    Args:
        task: The task.
        num_worlds: Number of worlds ``W``.
        num_threads: Simulation threads; 0 takes one per allowed processor.
        seed: Seed of the episodes that begin without a given seed; None takes another
            one every time (``env.simulation.seed``).

    Examples:
        >>> from gdrl_tasks import make_task
        >>> env = NavigationEnv(make_task("water"), num_worlds=4)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([4, 3, 1])
    """

    recorded = RECORDED
    """Arrays of the simulation that :meth:`entries` needs."""

    def __init__(
        self,
        task: NavigationTask,
        num_worlds: int,
        *,
        num_threads: int = 0,
        seed: int | None = None,
    ) -> None:
        super().__init__(batch_size=torch.Size([max(num_worlds, 0)]), device="cpu")
        self.simulation = BatchSimulation(
            task, num_worlds, num_threads=num_threads, seed=seed
        )
        self._begin_where_left = False
        self._make_specs(task, num_worlds)

    @property
    def task(self) -> NavigationTask:
        """The task that the worlds run."""
        return self.simulation.task

    def _make_specs(self, task: NavigationTask, num_worlds: int) -> None:
        low, high = (
            torch.as_tensor(bound, dtype=torch.float32).expand(num_worlds, -1)
            for bound in task.spec.observation_bounds
        )
        shape = torch.Size([num_worlds, 1])
        number = Unbounded(shape=shape, dtype=torch.float32)
        integer = Unbounded(shape=shape, dtype=torch.int64)
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: Bounded(low=low, high=high, dtype=torch.float32),
                keys.SUCCESS: flag_spec(shape),
                keys.OUTCOME: Categorical(len(Outcome), shape=shape, dtype=torch.int64),
                keys.EPISODE_NUMBER: integer,
                keys.EPISODE_SEED: integer.clone(),
                keys.EPISODE_STEPS: integer.clone(),
                keys.TIME_LEFT: number,
                keys.EPISODE_RETURN: number.clone(),
                keys.PATH_LENGTH: number.clone(),
                keys.SHORTEST_PATH: number.clone(),
            },
            shape=(num_worlds,),
        )
        self.action_spec = action_spec(task, (num_worlds,))
        low_reward, high_reward = task.spec.reward_range
        self.reward_spec = Bounded(
            low=low_reward, high=high_reward, shape=shape, dtype=torch.float32
        )
        self.done_spec = Composite(
            {
                name: flag_spec(shape)
                for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)
            },
            shape=(num_worlds,),
        )

    def _reset(
        self,
        tensordict: TensorDictBase | None,
        *,
        episode_seed: torch.Tensor | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get(keys.RESET_MASK, None)
        ids = (
            None if mask is None else mask.reshape(self.batch_size).nonzero()[:, 0].numpy()
        )
        if self._begin_where_left and ids is None and episode_seed is None:
            self._begin_where_left = False
        else:
            seeds = None
            if episode_seed is not None:
                seeds = torch.as_tensor(episode_seed).reshape(self.batch_size).numpy()
                seeds = seeds if ids is None else seeds[ids]
            self.simulation.reset(ids, seeds)
        return self.entries(self._observation(), self.simulation.arrays)

    def entries(self, observation: np.ndarray, arrays: dict[str, np.ndarray]) -> TensorDict:
        """All entries but the reward, of worlds or of worlds at several steps ``[...]``.

        Args:
            observation: What the worlds observe, ``[..., D]``, float32.
            arrays: Arrays of the simulation, ``[...]``, or rows of them.
        """
        return make_entries(self.task, observation, arrays)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get(keys.STEP_MASK, None)
        action = tensordict.get(keys.ACTION).detach().numpy()
        if mask is None:
            ids = None
            result = self.simulation.step(action)
        else:
            ids = mask.reshape(self.batch_size).nonzero()[:, 0].numpy()
            result = self.simulation.step(action[ids], ids)
        out = self.entries(self._observation(), self.simulation.arrays)
        reward = result.reward.astype(np.float32)
        if ids is not None:
            # Worlds that did not step have no reward; their done flags do not change.
            whole = np.zeros(self.batch_size, dtype=np.float32)
            whole[ids] = reward
            reward = whole
        return out.set(keys.REWARD, torch.from_numpy(reward)[:, None])

    def _observation(self) -> np.ndarray:
        return self.simulation.observe().astype(np.float32)

    def _set_seed(self, seed: int | None) -> None:
        self.simulation.seed = fresh_seed() if seed is None else seed
        self.simulation.num_episodes_begun = 0

    def watch(self, on_divergence: Callable[[DivergedWorld], object]) -> None:
        """Call a function with every world that diverges."""
        self.simulation.watch(on_divergence)

    def get_state(self) -> dict[str, torch.Tensor]:
        """The complete simulator state, as tensors by name (copies)."""
        state = self.simulation.get_state()
        return {name: torch.from_numpy(np.atleast_1d(v)) for name, v in state.items()}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Return to a state of :meth:`get_state`.

        The next full ``reset()`` without seeds goes on from there instead of beginning
        new episodes, so a collector built or reset afterwards continues exactly.
        """
        scalars = ("seed", "num_episodes_begun")
        arrays = {name: value.cpu().numpy() for name, value in state.items()}
        for name in scalars:
            if name in arrays:
                arrays[name] = arrays[name].reshape(())
        self.simulation.set_state(arrays)
        self._begin_where_left = True

    def close(self, **kwargs: Any) -> None:
        """Stop the simulation's threads."""
        self.simulation.close()
        super().close(**kwargs)


def flag_spec(shape: tuple[int, ...]) -> TensorSpec:
    """Spec of a boolean flag."""
    return Categorical(2, shape=torch.Size(shape), dtype=torch.bool)


def action_spec(task: NavigationTask, batch_size: tuple[int, ...]) -> TensorSpec:
    """Spec of a task's actions for worlds of a batch size."""
    size = task.spec.action_size
    if task.spec.is_discrete:
        return Categorical(size, shape=torch.Size(batch_size), dtype=torch.int64)
    return Bounded(
        low=-1.0, high=1.0, shape=torch.Size((*batch_size, size)), dtype=torch.float32
    )
