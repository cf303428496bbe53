"""The race beside an agent: when it is run, who wins it, what a victory changes."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs.utils import ExplorationType

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.race.hook import RaceHook
from gdrl_torchrl.evolution.settings import RaceConfig
from tests.evolution.race.conftest import STEPS, skill_of

LARGE = 0.5


def is_large(skill):
    return skill > LARGE


def test_nothing_is_evaluated_while_the_agent_succeeds(race_of):
    hook, evaluator, trainer = race_of(is_large)
    trainer.step(successes=3, episodes=10)
    assert evaluator.played == []
    assert (hook.counts.steps, hook.counts.evaluations) == (0, 0)
    trainer.step(episodes=30)
    assert evaluator.played


def test_races_take_their_share_of_the_steps(race_of):
    hook, _, trainer = race_of(share=0.75)
    for _ in range(20):
        trainer.step(episodes=1, frames=200)
    agent, population = trainer.collected_frames, hook.counts.steps
    # A round is whole, and has 18 steps.
    assert 3 * agent <= population < 3 * agent + 20 * 18
    assert hook.counts.steps == hook.counts.evaluations * 6 * STEPS


def test_a_share_of_nothing_is_the_bare_agent(race_of):
    hook, evaluator, trainer = race_of(is_large, share=0.0)
    before = genome_of(hook.actor)
    for _ in range(5):
        trainer.step(episodes=10)
    assert evaluator.played == []
    assert (genome_of(hook.actor) == before).all()


def test_who_fails_plays_one_episode_and_who_succeeds_plays_on(race_of):
    hook, evaluator, _ = race_of(is_large, least_success=1.0, num_trials=4)
    seen = {}
    while not hook.counts.switches:
        hook.evaluate()
    for population, trials in evaluator.played:
        for member in population:
            seen.setdefault(skill_of(member), []).append(trials)
    failed = [plays for skill, plays in seen.items() if not is_large(skill)]
    again = [plays for skill, plays in seen.items() if is_large(skill)]
    assert failed
    assert all(plays == [1] for plays in failed)
    # One success brings it in, two more bring it to the test.
    assert max(again, key=len) == [1, 1, 1, 4]


def test_a_victory_is_a_hand_over(race_of, skill):
    hook, evaluator, trainer = race_of(is_large, action_std=0.25)
    objects = [id(p) for p in hook.actor.parameters()]
    trainer.step(episodes=12, frames=10_000)
    assert hook.counts.switches == 1
    [(tested, trials)] = evaluator.played[-1:]
    assert trials == 4
    assert skill(hook.actor) == skill_of(tested[0])
    assert is_large(skill(hook.actor))
    assert [id(p) for p in hook.actor.parameters()] == objects
    assert hook.noise.std == pytest.approx(0.25)
    assert len(hook.watch.window) == 0
    assert trainer.updated == 1
    assert (hook.champion.successes, hook.champion.episodes) == (4, 4)
    # The steps of the test are counted.
    assert hook.counts.steps == evaluator.steps
    # Then the agent has time to show what it can.
    played = len(evaluator.played)
    trainer.step(episodes=9, frames=10_000)
    assert len(evaluator.played) == played
    trainer.step(episodes=1, frames=10_000)
    assert len(evaluator.played) > played


@pytest.mark.parametrize(
    ("most", "expected"), [(0.9, 0.8), (0.5, 0.4), (0.3, 0.2), (0, 0.2)]
)
def test_the_agent_gets_as_much_noise_as_it_bears(race_of, most, expected):
    hook, evaluator, trainer = race_of(is_large, action_std=0.8)
    evaluator.bears = lambda: hook.noise.std < most
    trainer.step(episodes=12, frames=10_000)
    assert hook.counts.switches == 1
    assert hook.noise.std == pytest.approx(expected)
    assert evaluator.exploration_type is ExplorationType.DETERMINISTIC
    assert hook.counts.steps == evaluator.steps
    for population, trials in evaluator.sampled:
        assert trials == 4
        assert (population[0] == genome_of(hook.actor)).all()


def test_moments_of_the_actor_are_forgotten_on_a_victory(race_of):
    made = []

    def adam(parameters):
        made.append(torch.optim.Adam(parameters))
        return made[0]

    hook, _, trainer = race_of(is_large, optimizer=adam)
    [optimizer] = made
    sum(p.sum() for p in hook.actor.parameters()).backward()
    optimizer.step()
    assert optimizer.state
    trainer.step(episodes=12, frames=10_000)
    assert hook.counts.switches == 1
    assert not optimizer.state


def test_who_fails_the_test_does_not_become_the_agent(race_of):
    hook, evaluator, _ = race_of(is_large)
    lucky = evaluator.evaluate_with_transitions

    def only_single_episodes(population, *, seeds):
        scores, transitions = lucky(population, seeds=seeds)
        if len(seeds) > 1:
            scores[keys.SUCCESSES].zero_()
        return scores, transitions

    evaluator.evaluate_with_transitions = only_single_episodes
    before = genome_of(hook.actor)
    for _ in range(60):
        assert not hook.evaluate().switched
    assert any(trials == 4 for _, trials in evaluator.played)
    assert (genome_of(hook.actor) == before).all()
    assert not hook.champion


def test_a_member_without_numbers_never_wins(race_of):
    hook, _, _ = race_of(lambda skill: True, new_std=0.86)
    mutated = hook.breeding._mutated

    def broken(*args):
        return mutated(*args).apply(lambda leaf: leaf * torch.nan)

    hook.breeding._mutated = broken
    for _ in range(5):
        evaluation = hook.evaluate()
        assert evaluation.scores[keys.FITNESS].isnan().all()
        assert not evaluation.switched
    assert len(hook.candidates) == 0
    assert hook.counts.without_fitness == 5


@pytest.fixture
def won(race_of):
    """A race that was won, and the agent's weights then."""

    def make(**settings):
        hook, _, trainer = race_of(is_large, **settings)
        trainer.step(episodes=12, frames=10_000)
        assert hook.counts.switches == 1
        return hook, trainer, {n: p.clone() for n, p in hook.actor.named_parameters()}

    return make


def ruin(actor):
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(3.0)


def test_a_collapse_is_undone_within_a_window(won):
    hook, trainer, before = won(action_std=None, num_trials=8, patience_episodes=30)
    ruin(hook.actor)
    trainer.step(successes=0, episodes=19)
    assert hook.num_rollbacks == 0, "fewer than twenty episodes tell nothing"
    trainer.step(successes=0, episodes=1)
    assert hook.num_rollbacks == 1
    assert all(torch.equal(p, before[n]) for n, p in hook.actor.named_parameters())
    assert trainer.updated == 2
    assert len(hook.watch.window) == 0


def test_a_way_back_lowers_the_noise(won):
    hook, trainer, _ = won(
        action_std=0.8, rollback_noise=0.5, num_trials=8, patience_episodes=30
    )
    trainer.step(successes=0, episodes=25)
    assert hook.num_rollbacks == 1
    assert hook.noise.std == pytest.approx(0.4)


def test_an_agent_that_gets_better_is_the_new_champion(won):
    hook, trainer, _ = won(action_std=None, num_trials=8, patience_episodes=30)
    # The record of the test was perfect, so it is made one that can be passed.
    hook.champion.successes = 5
    ruin(hook.actor)
    after = {n: p.clone() for n, p in hook.actor.named_parameters()}
    trainer.step(successes=18, episodes=20)
    assert (hook.champion.successes, hook.champion.episodes) == (18, 20)
    ruin(hook.actor)
    trainer.step(successes=0, episodes=30)
    assert hook.num_rollbacks == 1
    assert all(torch.equal(p, after[n]) for n, p in hook.actor.named_parameters())


def test_without_a_level_it_never_goes_back(won):
    hook, trainer, _ = won(rollback_level=0.0, patience_episodes=60, window_episodes=30)
    for _ in range(5):
        trainer.step(successes=0, episodes=30)
    assert hook.num_rollbacks == 0


def test_the_control_hands_over_a_new_member(race_of, skill):
    hook, evaluator, trainer = race_of(is_large, hand_over="random")
    trainer.step(episodes=12, frames=10_000)
    assert hook.counts.switches == 1
    skills = {
        skill_of(member) for population, _ in evaluator.played for member in population
    }
    assert skill(hook.actor) not in skills
    assert skill(hook.actor) != 0.0


def test_it_goes_on_exactly_from_a_state(race_of):
    settings = {"num_distilled": 2, "distillation_updates": 3, "least_success": 0.9}
    one, _, first = race_of(lambda s: math.sin(40 * s) > 0.5, **settings)
    for _ in range(4):
        first.step(episodes=3, frames=60)
    state = one.state_dict()
    weights = {n: p.clone() for n, p in one.actor.named_parameters()}
    other, _, second = race_of(lambda s: math.sin(40 * s) > 0.5, **settings)
    other.load_state_dict(state)
    other.actor.load_state_dict(weights)
    second.collected_frames = first.collected_frames
    played = len(one.evaluator.played)
    for trainer in (first, second):
        for _ in range(6):
            trainer.step(episodes=3, frames=60)
    later = one.evaluator.played[played:]
    assert len(later) == len(other.evaluator.played)
    for (expected, n), (found, m) in zip(later, other.evaluator.played, strict=True):
        assert n == m
        assert (expected == found).all()
    assert one.counts == other.counts


def test_noise_that_a_policy_has_not_is_refused(actor_of):
    actor = actor_of("q_value")
    with pytest.raises(ValueError, match="action_std needs a policy with a parameter"):
        RaceHook(actor, None, RaceConfig(num_distilled=0))
