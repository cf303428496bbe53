"""Hooks whose evaluations are scripted, and batches of episodes that are drawn as text."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from gdrl_torchrl.evolution.hooks.breeding import breeding_of
from gdrl_torchrl.evolution.hooks.contest import contest_of
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.hand_over import hand_over_of
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.settings import EvolutionConfig


class ScriptedEvaluator:
    """Gives scores from a list, and keeps the populations that it was shown."""

    def __init__(self, *fitness, returns=None, frames=7):
        self.fitness, self.returns, self.frames = list(fitness), returns, frames
        self.populations = []
        # A hook restores it, so it is what the script goes by.
        self.episodes_drawn = 0

    @property
    def num_evaluations(self):
        return self.episodes_drawn

    def evaluate(self, population, *, seeds=None):
        scores = torch.tensor(self.fitness[self.num_evaluations % len(self.fitness)])
        self.episodes_drawn += 1
        self.populations.append(population.clone())
        count = population.batch_size[0]
        assert scores.shape == (count,)
        returns = torch.zeros(count) if self.returns is None else torch.tensor(self.returns)
        return TensorDict(
            fitness=scores,
            success_rate=scores / 10.0,
            return_mean=returns,
            frames=torch.full((count,), self.frames),
            batch_size=[count],
        )

    def close(self):
        pass


PARENT_WINS, CHILD_WINS = [5.0, 1.0, 1.0], [1.0, 1.0, 5.0]


def hook_of(
    actor,
    evaluator,
    breeding=None,
    *,
    optimizer=None,
    critic=None,
    on_evaluation=(),
    **settings,
):
    """A hook of two children, whose parts have these settings."""
    settings = EvolutionConfig(**{"num_children": 2, "period_episodes": 4} | settings)
    return GeneticHook(
        actor,
        evaluator,
        breeding or breeding_of(settings, actor),
        contest_of(settings),
        hand_over_of(settings, actor, optimizer=optimizer, critic=critic),
        watch=EpisodeWatch(settings.window_episodes),
        period_episodes=settings.period_episodes,
        success_range=settings.success_range,
        rate_of=settings.rate_of,
        on_evaluation=on_evaluation,
    )


def batch_of(*worlds):
    """A batch ``[W, T]`` from strings: a digit is a step of that episode; ``+`` and
    ``-`` after it end the episode with and without success."""
    rows = []
    for world in worlds:
        steps = []
        for symbol in world:
            if symbol in "+-":
                steps[-1] = (steps[-1][0], True, symbol == "+")
            else:
                steps.append((int(symbol), False, False))
        rows.append(steps)
    number, done, success = (
        torch.tensor([[step[i] for step in row] for row in rows])[..., None]
        for i in range(3)
    )
    size = number.shape[:2]
    following = TensorDict(done=done, success=success, batch_size=size)
    return TensorDict(episode_number=number, next=following, batch_size=size)
