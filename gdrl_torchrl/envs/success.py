"""A flag of success for environments that have none: the return of an episode."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary
from torchrl.envs import Transform

from gdrl_torchrl import keys

_RETURN = "episode_reward"


class ReturnSuccess(Transform):
    """Writes ``success``: whether the return so far is at least a threshold.

    It is appended after TorchRL's ``RewardSum``, which writes the return. At the end of an
    episode the flag says whether the episode has succeeded; hooks and evaluators look at
    it there.

    Args:
        threshold: Return that is a success, above 0.

    Raises:
        ValueError: If the threshold is not above 0, with which every episode would begin
            with success.

    Examples:
        >>> from torchrl.envs import Compose, GymEnv, RewardSum, TransformedEnv
        >>> threshold = Compose(RewardSum(), ReturnSuccess(5.0))
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), threshold)
        >>> steps = env.rollout(6)
        >>> steps["next", "success"].flatten().tolist()[:5]
        [False, False, False, False, True]
    """

    def __init__(self, threshold: float) -> None:
        if not threshold > 0.0:
            raise ValueError(f"threshold={threshold} must be > 0")
        super().__init__(in_keys=[_RETURN], out_keys=[keys.SUCCESS])
        self.threshold = threshold

    def _apply_transform(self, obs: torch.Tensor) -> torch.Tensor:
        return obs >= self.threshold

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Any) -> Any:
        """The environment's observations, with the flag."""
        shape = observation_spec[_RETURN].shape
        flag = Binary(shape=shape, dtype=torch.bool, device=observation_spec.device)
        observation_spec[keys.SUCCESS] = flag
        return observation_spec
