"""Races whose episodes are decided by a rule on weights."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.race.hook import RaceHook
from gdrl_torchrl.evolution.settings import RaceConfig

STEPS = 3
SMALL = {
    "num_members": 6,
    "num_trials": 4,
    "num_distilled": 0,
    "num_again": 3,
    "patience_episodes": 10,
    "window_episodes": 30,
}


def skill_of(genome):
    """What decides: one of the weights."""
    return float(next(iter(genome.values(True, True))).flatten()[0])


class RuleEvaluator:
    """Every episode of a member succeeds, or none, by what a function says of its skill.

    Episodes last three steps; a member whose skill is NaN has no fitness.
    """

    num_episodes = 4

    def __init__(self, succeeds):
        self.succeeds = succeeds
        self.episodes_drawn = 0
        self.played = []

    def fresh_seeds(self, count):
        first, self.episodes_drawn = self.episodes_drawn, self.episodes_drawn + count
        return torch.arange(first, first + count)

    @property
    def steps(self):
        """All that were played."""
        return sum(STEPS * len(population) * trials for population, trials in self.played)

    def evaluate_with_transitions(self, population, *, seeds):
        count, trials = population.batch_size[0], len(seeds)
        self.played.append((population.clone(), trials))
        skill = torch.tensor([skill_of(member) for member in population])
        won = torch.tensor([bool(self.succeeds(float(s))) for s in skill])
        rows = count * trials * STEPS
        scores = TensorDict(
            {
                keys.FITNESS: won.float().mul(trials).masked_fill(skill.isnan(), torch.nan),
                keys.SUCCESS_RATE: won.float(),
                keys.RETURN_MEAN: won.float(),
                keys.FRAMES: torch.full((count,), trials * STEPS),
                keys.STEPS: torch.full((count, trials), STEPS),
                keys.SUCCESSES: won[:, None].expand(count, trials).clone(),
            },
            batch_size=[count],
        )
        member = torch.arange(count).repeat_interleave(trials * STEPS)
        transitions = TensorDict(
            {
                keys.OBSERVATION: torch.linspace(-1, 1, rows)[:, None].expand(rows, 3),
                keys.ACTION: skill[member][:, None].expand(rows, 2).clone().nan_to_num(),
            },
            batch_size=[rows],
        )
        return scores, transitions

    def close(self):
        pass


class Trainer:
    """Collects steps, of which some end episodes."""

    def __init__(self, hook):
        self.hook, self.collected_frames = hook, 0
        self.ops = {}
        self.collector = SimpleNamespace(update_policy_weights_=self.note)
        self.updated = 0
        hook.register(self)

    def note(self):
        self.updated += 1

    def register_op(self, dest, op, **options):
        self.ops.setdefault(dest, []).append(op)

    def register_module(self, name, module):
        pass

    def step(self, successes=0, episodes=0, frames=100):
        """A batch with so many episodes that end, and what follows it."""
        self.collected_frames += frames
        self.hook.watch.note([True] * successes + [False] * (episodes - successes))
        self.hook()


@pytest.fixture
def race_of(actor_of):
    """Makes a race of an actor whose skill is 0, its evaluator and its trainer."""

    def make(succeeds=lambda skill: False, optimizer=None, **settings):
        torch.manual_seed(0)
        actor = actor_of("tanh_normal")
        with torch.no_grad():
            next(actor.parameters()).flatten()[0] = 0.0
        if optimizer is not None:
            optimizer = optimizer(actor.parameters())
        hook = RaceHook(
            actor,
            RuleEvaluator(succeeds),
            RaceConfig(**SMALL | settings),
            optimizer=optimizer,
            seed=settings.pop("seed", 3),
        )
        return hook, hook.evaluator, Trainer(hook)

    return make


@pytest.fixture
def skill():
    return lambda actor: skill_of(genome_of(actor))
