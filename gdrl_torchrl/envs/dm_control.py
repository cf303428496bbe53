"""The dm_control route: one world per environment, through TorchRL's own wrapper."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import DMControlWrapper, SerialEnv

from gdrl_tasks import NavigationTask, Outcome
from gdrl_tasks.engines.dm_env import make_environment
from gdrl_tasks.task import check_running
from gdrl_torchrl import keys
from gdrl_torchrl.envs.navigation import action_spec, flag_spec


class NavigationDMControlEnv(DMControlWrapper):
    """A task's dm_control environment with the keys of navigation environments.

    The reference for :class:`~gdrl_torchrl.envs.navigation.NavigationEnv`, with one
    world and batch size ``[]``: flat float32 ``observation``, and ``success``,
    ``outcome``, ``episode_seed``, ``episode_return``, ``path_length`` and
    ``shortest_path`` beside TorchRL's own keys. ``reset(episode_seed=seed)`` chooses
    the episode.

    Args:
        task: The task.
        seed: Seed of its episodes; None takes a different one every time.

    Examples:
        >>> from gdrl_tasks import make_task
        >>> env = NavigationDMControlEnv(make_task("water"))
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([3, 1])
    """

    def __init__(self, task: NavigationTask, *, seed: int | None = None) -> None:
        super().__init__(make_environment(task, random=seed))

    @property
    def task(self) -> NavigationTask:
        """The task that the environment runs."""
        return self._env.task.task

    def _make_specs(self, env: Any) -> None:
        super()._make_specs(env)
        task = env.task.task
        low, high = (
            torch.as_tensor(bound, dtype=torch.float32)
            for bound in task.spec.observation_bounds
        )
        one = torch.Size([1])
        number = Unbounded(shape=one, dtype=torch.float32)
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: Bounded(low=low, high=high, dtype=torch.float32),
                keys.SUCCESS: flag_spec((1,)),
                keys.OUTCOME: Categorical(len(Outcome), shape=one, dtype=torch.int64),
                keys.EPISODE_SEED: Unbounded(shape=one, dtype=torch.int64),
                keys.TIME_LEFT: number,
                keys.EPISODE_RETURN: number.clone(),
                keys.PATH_LENGTH: number.clone(),
                keys.SHORTEST_PATH: number.clone(),
            }
        )
        self.reward_spec = Bounded(*task.spec.reward_range, shape=one, dtype=torch.float32)
        self.action_spec = action_spec(task, ())

    def read_obs(self, observations: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
        """Flatten the named observations and add the episode's record."""
        flat = np.concatenate([np.ravel(value) for value in observations.values()])
        suite_task = self._env.task
        read = {
            keys.OBSERVATION: torch.from_numpy(flat.astype(np.float32)),
            keys.SUCCESS: torch.tensor([suite_task.outcome == Outcome.SUCCESS]),
            keys.OUTCOME: torch.tensor([int(suite_task.outcome)]),
            keys.EPISODE_SEED: torch.tensor(suite_task.arrays["episode_seed"]),
        }
        time_left = 1.0 - suite_task.arrays["steps"] / self.task.spec.step_limit
        read[keys.TIME_LEFT] = torch.from_numpy(time_left.astype(np.float32))
        for name in (keys.EPISODE_RETURN, keys.PATH_LENGTH, keys.SHORTEST_PATH):
            value = suite_task.arrays[name].astype(np.float32)
            read[name] = torch.from_numpy(value)
        return read

    def read_action(self, action: torch.Tensor) -> np.ndarray:
        """Actions as NumPy arrays; discrete actions remain indices."""
        return action.detach().cpu().numpy()

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        episode_seed: torch.Tensor | int | None = None,
        **kwargs: Any,
    ) -> TensorDictBase:
        if episode_seed is not None:
            self._env.task.next_episode_seed = int(episode_seed)
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # After an end dm_control would begin a new episode, whose first step has no reward.
        check_running(np.zeros(1, dtype=np.int64), self._env.task.arrays["outcome"])
        out = super()._step(tensordict)
        return out.set(keys.REWARD, out[keys.REWARD].to(torch.float32))


class SerialWorlds(SerialEnv):
    """Several :class:`NavigationDMControlEnv`, stepped one after another.

    dm_control gives no access to all that a world's future depends on: there is no state
    to return to, and whoever would return begins new episodes.
    """

    def watch(self, on_divergence: Callable[..., object]) -> None:
        """Do nothing: a world that diverges only ends as such."""

    def get_state(self) -> dict[str, torch.Tensor]:
        """Nothing."""
        return {}

    def set_state(self, state: dict[str, torch.Tensor]) -> None:
        """Do nothing; the next reset begins new episodes."""
