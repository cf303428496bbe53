"""The race beside an agent: when it is run, who wins it, what a victory changes."""

from __future__ import annotations

import math

import torch

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.genome import genome_of
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
    hook, evaluator, _ = race_of(is_large, least_success=1.0, num_trials=4, new_rate=1.0)
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
    hook, evaluator, trainer = race_of(is_large)
    objects = [id(p) for p in hook.actor.parameters()]
    trainer.step(episodes=12, frames=10_000)
    assert hook.counts.switches == 1
    [(tested, trials)] = evaluator.played[-1:]
    assert trials == 4
    assert skill(hook.actor) == skill_of(tested[0])
    assert is_large(skill(hook.actor))
    assert [id(p) for p in hook.actor.parameters()] == objects
    assert len(hook.watch.window) == 0
    assert trainer.updated == 1
    # The steps of the test are counted.
    assert hook.counts.steps == evaluator.steps
    # Then the agent has time to show what it can.
    played = len(evaluator.played)
    trainer.step(episodes=9, frames=10_000)
    assert len(evaluator.played) == played
    trainer.step(episodes=1, frames=10_000)
    assert len(evaluator.played) > played


def test_a_long_race_is_content_with_less(race_of):
    """Who succeeds in every other episode of the test passes after some time."""
    settings = {"least_success": 0.8, "halving_steps": 1200, "num_trials": 10}
    hook, evaluator, _ = race_of(is_large, **settings)
    play = evaluator.evaluate_with_transitions

    def half_of_a_test(population, *, seeds):
        scores, transitions = play(population, seeds=seeds)
        if len(seeds) > 1:
            scores[keys.SUCCESSES][:, ::2] = False
        return scores, transitions

    evaluator.evaluate_with_transitions = half_of_a_test
    while not hook.evaluate().switched:
        pass
    # 0.8 / 2 ** (steps / 1200) is a half then.
    first = 1200 * math.log2(0.8 / 0.5)
    assert first <= hook.counts.steps < first + 10 * 6 * STEPS


def test_nobody_takes_the_place_of_an_agent_that_does_better(race_of):
    """The race is on below 0.9, and who is tested reaches the goal in three of four."""
    hook, evaluator, trainer = race_of(is_large, least_success=0.5, race_below=0.9)
    play = evaluator.evaluate_with_transitions

    def part_of_a_test(population, *, seeds):
        scores, transitions = play(population, seeds=seeds)
        if len(seeds) > 1:
            scores[keys.SUCCESSES][:, 0] = False
        return scores, transitions

    evaluator.evaluate_with_transitions = part_of_a_test
    trainer.step(successes=24, episodes=30, frames=3_000)
    assert any(trials == 4 for _, trials in evaluator.played)
    assert hook.counts.switches == 0, "0.75 in the test are less than the agent's 0.8"
    trainer.step(successes=0, episodes=10, frames=3_000)
    assert hook.counts.switches == 1


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
    assert hook.counts.switches == 0


def test_a_member_without_numbers_never_wins(race_of):
    hook, _, _ = race_of(lambda skill: True)
    hook.breeding.first.apply_(lambda leaf: leaf.fill_(torch.nan))
    for _ in range(5):
        evaluation = hook.evaluate()
        assert evaluation.scores[keys.FITNESS].isnan().all()
        assert not evaluation.switched
    assert len(hook.candidates) == 0
    assert hook.counts.without_fitness == 5


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
