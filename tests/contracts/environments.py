"""Environments that policies unlike our own act in."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import Transform


def pendulum() -> EnvBase:
    return GymEnv("Pendulum-v1")


def one_in_a_batch() -> EnvBase:
    """For layers that want rows ``[B, N]``."""
    return SerialEnv(1, pendulum)


def cart_pole() -> EnvBase:
    return GymEnv("CartPole-v1", categorical_action_encoding=True)


class ActionMask(Transform):
    """Adds which of CartPole's two actions are allowed."""

    def _call(self, next_tensordict: Any) -> Any:
        angle = next_tensordict["observation"][..., 2]
        mask = torch.stack([angle <= 0.03, angle >= -0.03], dim=-1)
        return next_tensordict.set("action_mask", mask)

    def _reset(self, tensordict: Any, tensordict_reset: Any) -> Any:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Any) -> Any:
        observation_spec["action_mask"] = Categorical(2, shape=(2,), dtype=torch.bool)
        return observation_spec


def masked() -> EnvBase:
    return TransformedEnv(cart_pole(), ActionMask())


class Picture(gymnasium.Env):
    """Push a bright column of a picture to the middle."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1, 8, 8), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(0.0, 8.0)
        return self._picture(), {}

    def step(self, action: Any) -> tuple:
        self.place = float(np.clip(self.place + 0.1 * action[0], 0.0, 7.99))
        return self._picture(), -abs(self.place - 4.0), False, False, {}

    def _picture(self) -> np.ndarray:
        return (
            np.exp(-((np.arange(8.0) - self.place) ** 2))[None, None]
            .repeat(8, axis=1)
            .astype(np.float32)
        )


class Panel(gymnasium.Env):
    """Two switches and a dial: a dictionary of observations, MultiDiscrete actions."""

    observation_space = gymnasium.spaces.Dict(
        {
            "dial": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
            "lamp": gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32),
        }
    )
    action_space = gymnasium.spaces.MultiDiscrete([3, 2])

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple:
        super().reset(seed=seed)
        self.dial = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        return self._see(), {}

    def step(self, action: Any) -> tuple:
        self.dial[0] = np.clip(self.dial[0] + 0.1 * (int(action[0]) - 1), -1.0, 1.0)
        self.dial[1] *= -1.0 if int(action[1]) else 0.9
        return self._see(), float(self.dial.sum()), False, False, {}

    def _see(self) -> dict[str, np.ndarray]:
        return {"dial": self.dial.copy(), "lamp": np.abs(self.dial[:1])}


class TwoArms(EnvBase):
    """Two arms that move apart, with an action each, one of them nested."""

    def __init__(self) -> None:
        super().__init__(batch_size=[])
        self.observation_spec = Composite(observation=Unbounded((2,)))
        self.action_spec = Composite(
            left=Bounded(-1.0, 1.0, (1,)), arm=Composite(right=Bounded(-1.0, 1.0, (1,)))
        )
        self.reward_spec = Unbounded((1,))
        self.generator = torch.Generator()

    def _reset(self, tensordict: Any, **kwargs: Any) -> Any:
        self.place = torch.randn(2, generator=self.generator)
        return TensorDict(
            observation=self.place.clone(), done=torch.zeros(1, dtype=torch.bool)
        )

    def _step(self, tensordict: Any) -> Any:
        pushes = torch.cat([tensordict["left"], tensordict["arm", "right"]])
        self.place = self.place + 0.1 * pushes
        return TensorDict(
            observation=self.place.clone(),
            reward=-self.place.abs().sum(0, keepdim=True),
            done=torch.zeros(1, dtype=torch.bool),
        )

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)
