"""One batch of members and episodes in an environment, until every episode has ended."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.utils import step_mdp

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.population.actor import PopulationActor
from gdrl_torchrl.evolution.population.episodes import mark_truncated
from gdrl_torchrl.evolution.population.rules import EvaluationRules

LONGEST_EPISODE = 100_000
"""After so many steps an episode without a limit is taken to be endless."""


class PopulationRollout:
    """One batch of members and episodes in an environment, until all have ended."""

    def __init__(
        self,
        rules: EvaluationRules,
        population: PopulationActor,
        env: EnvBase,
        scores: TensorDictBase,
        seeds: torch.Tensor,
    ) -> None:
        self.rules, self.population, self.env = rules, population, env
        self.scores, self.seeds = scores, seeds
        self.used = scores.numel()

    def run(self, log: list[TensorDictBase] | None, offset: tuple[int, int]) -> None:
        """Fill the scores ``[p, s]``; append transitions to ``log``.

        Raises:
            RuntimeError: If episodes do not end and have no limit.
        """
        env, used = self.env, self.used
        worlds = env.batch_size.numel()
        td = self._reset()
        alive = torch.zeros(worlds, dtype=torch.bool)
        alive[:used] = True
        returns = torch.zeros(worlds, dtype=torch.float64)
        steps = torch.zeros(worlds, dtype=torch.int64)
        final_keys = self.rules.final_keys
        final = {
            name: torch.zeros(worlds, dtype=self.scores[name].dtype)
            for name in final_keys.values()
        }
        finite = torch.ones(worlds, dtype=torch.bool)
        limit = self.rules.max_steps
        while bool(alive.any()):
            td = self._act(td, finite, alive)
            if not bool(alive.all()):
                td.set(keys.STEP_MASK, alive.reshape(env.batch_size))
            td = env.step(td)
            following = td["next"]
            reward = following[keys.REWARD].reshape(worlds).to(torch.float64)
            done = following[keys.DONE].reshape(worlds)
            # Worlds whose episode has ended repeat their last step, which does not count.
            returns += torch.where(alive, reward, 0.0)
            steps += alive
            cut = torch.zeros_like(done) if limit is None else steps >= limit
            if log is not None:
                log.append(self._transitions(td, alive, steps - 1, offset, cut & ~done))
            # An episode that is cut off ends there: what it has by then is what it has.
            ended = alive & (done | cut)
            if bool(ended.any()):
                for key, name in final_keys.items():
                    value = following[key].reshape(worlds)
                    final[name] = torch.where(ended, value, final[name])
            alive = alive & ~done & ~cut
            if limit is None and int(steps.max()) >= LONGEST_EPISODE:
                raise RuntimeError(
                    f"{int(alive.sum())} episodes have not ended after {LONGEST_EPISODE} "
                    "steps: max_steps=None waits for the environment's own end; set it"
                )
            td = step_mdp(td, exclude_action=True)
        scores = self.scores
        final |= {"return": returns.float(), "steps": steps, "finite": finite}
        for name, value in final.items():
            scores.set_(name, value[:used].reshape(scores.batch_size))

    def _reset(self) -> TensorDictBase:
        env = self.env
        seeding = self.rules.seeding
        worlds = env.batch_size.numel()
        seeds = self.seeds.repeat(-(-worlds // len(self.seeds)))[:worlds]
        if seeding == "reset" and isinstance(env, BatchedEnvBase):
            each = [{"episode_seed": int(seed)} for seed in seeds]
            return env.reset(list_of_kwargs=each)
        if seeding == "reset":
            return env.reset(episode_seed=seeds.reshape(env.batch_size))
        if seeding == "set_seed":
            env.set_seed(int(self.seeds[0] % 2**31))
        return env.reset()

    def _act(
        self, td: TensorDictBase, finite: torch.Tensor, alive: torch.Tensor
    ) -> TensorDictBase:
        population, used = self.population, self.used
        rows: Any = td.select(*population.in_keys).reshape(-1)
        rows = population(rows[:used] if used < rows.shape[0] else rows)
        acted = rows.pop("policy_is_finite")
        for key in self.env.action_keys:
            action = rows.get(key)
            if action.dtype.is_floating_point:
                strange = ~torch.isfinite(action)
                rows.set(key, action.masked_fill(strange, 0.0))
                acted = acted & ~strange.reshape(used, -1).any(dim=1)
        finite[:used] &= acted | ~alive[:used]
        if used < self.env.batch_size.numel():
            idle = rows[:1].expand(self.env.batch_size.numel() - used)
            rows = torch.cat([rows, idle.clone()])
        # Not all outputs of the policy are kept: the value distributions of all actions
        # would be most of a transition.
        needed = rows.select(*self.env.action_keys, "next", strict=False)
        return td.update(needed.reshape(self.env.batch_size))

    def _transitions(
        self,
        td: TensorDictBase,
        alive: torch.Tensor,
        steps: torch.Tensor,
        offset: tuple[int, int],
        cut: torch.Tensor,
    ) -> TensorDictBase:
        """Transitions ``[L]`` of living worlds, truncated where episodes are cut."""
        trials = self.scores.batch_size[1]
        flat = td.exclude(keys.STEP_MASK).reshape(-1)[alive].clone()
        world = alive.nonzero()[:, 0]
        flat["member"] = offset[0] + world // trials
        flat["episode"] = offset[1] + world % trials
        flat["time"] = steps[alive]
        mark_truncated(flat["next"], cut[alive])
        return flat
