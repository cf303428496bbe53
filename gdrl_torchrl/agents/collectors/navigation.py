"""Collectors: TorchRL's, and one that makes a batch of worlds' steps at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import set_exploration_type

from gdrl_torchrl import keys
from gdrl_torchrl.agents.collectors.collects import EnvCollector
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.envs.record import StepRecord
from gdrl_torchrl.fast.policy import TracedPolicy

_OPTIONS = (
    "frames_per_batch",
    "total_frames",
    "exploration_type",
    "postproc",
    "auto_register_policy_transforms",
)


def make_collector(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    policy_keys: Sequence[str],
) -> EnvCollector:
    """Make the fastest collector for an environment.

    Args:
        env: The environment; if it is a :class:`NavigationEnv`, and the policy acts on
            observations alone, a :class:`NavigationCollector` steps it.
        policy: What acts.
        frames_per_batch: Environment steps of a batch, over all worlds.
        policy_keys: Outputs of the policy, beside the action, that batches must hold.
    """
    kind: Any = EnvCollector
    options: dict[str, Any] = {}
    if isinstance(env, NavigationEnv) and list(policy.in_keys) == [keys.OBSERVATION]:
        kind, options = NavigationCollector, {"policy_keys": policy_keys}
    return kind(
        env,
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
        **options,
    )


class NavigationCollector(EnvCollector):
    """TorchRL's collector for a :class:`NavigationEnv`, with no tensordict per step.

    Its batches ``[W, T]`` hold the same numbers, with those outputs of the policy that
    are asked for and without trajectory ids: ``episode_number`` is one. Everything else,
    weights and iteration included, is the base's.

    Args:
        create_env_fn: The environment, not wrapped.
        policy: Acts on observations alone.
        policy_keys: Outputs of the policy, beside the action, that the batches hold.
        trace: Whether to trace the policy. One that keeps a state in Python objects must
            not be.
        **options: As of :class:`torchrl.collectors.Collector`: ``frames_per_batch``,
            ``total_frames``, ``exploration_type``, ``postproc`` and
            ``auto_register_policy_transforms``.

    Raises:
        ValueError: If another option of that is given: it would do nothing.

    Examples:
        >>> from gdrl_tasks import make_task
        >>> from gdrl_torchrl.agents.networks import make_tanh_normal_actor
        >>> env = NavigationEnv(make_task("water"), num_worlds=4)
        >>> actor = make_tanh_normal_actor(3, env.full_action_spec_unbatched["action"])
        >>> collector = NavigationCollector(
        ...     env, actor, policy_keys=[], frames_per_batch=20, total_frames=-1
        ... )
        >>> batch = next(iter(collector))
        >>> batch.batch_size, batch["action"].shape
        (torch.Size([4, 5]), torch.Size([4, 5, 2]))
    """

    def __init__(
        self,
        create_env_fn: NavigationEnv,
        policy: TensorDictModuleBase,
        *,
        policy_keys: Sequence[str],
        trace: bool = True,
        **options: Any,
    ) -> None:
        unknown = sorted(set(options) - set(_OPTIONS))
        if unknown:
            raise ValueError(
                f"options {unknown} are not those of a NavigationCollector, {_OPTIONS}: "
                "take TorchRL's Collector"
            )
        super().__init__(create_env_fn, policy, track_traj_ids=False, **options)
        self.traced_policy = TracedPolicy(policy, [keys.ACTION, *policy_keys], trace=trace)

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Collect the next batch ``[W, T]``."""
        env = self.env
        simulation = env.simulation
        worlds, steps = simulation.num_worlds, self.frames_per_batch
        before, after = (StepRecord(simulation, steps) for _ in range(2))
        rewards = np.empty((worlds, steps, 1), dtype=np.float32)
        outputs: list[Sequence[torch.Tensor]] = []
        observation = self._carrier.get(keys.OBSERVATION).numpy()
        with set_exploration_type(self.exploration_type):
            act = self.traced_policy.bind([torch.from_numpy(observation)])
            for step in range(steps):
                before.note(step, observation)
                outputs.append(act(torch.from_numpy(observation)))
                result = simulation.step(outputs[-1][0].numpy())
                observation = result.observation.astype(np.float32)
                rewards[:, step, 0] = result.reward
                after.note(step, observation)
                ended = result.terminated | result.truncated
                if ended.any():
                    observation[ended] = simulation.reset(ended.nonzero()[0])
        batch = before.tensordict()
        following = after.tensordict()
        following.set(keys.REWARD, torch.from_numpy(rewards))
        chosen = zip(self.traced_policy.out_keys, zip(*outputs, strict=True), strict=True)
        for key, values in chosen:
            batch.set(key, torch.stack(values, dim=1))
        self._carrier = env.entries(observation, simulation.arrays)
        return batch.set("next", following)
