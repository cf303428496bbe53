"""The genetic hook: when it evaluates, who wins, what it counts, and its state."""

from __future__ import annotations

import pytest
import torch

from gdrl_torchrl.evolution.operators.genome import genome_of
from tests.evolution.hooks.scripted import (
    CHILD_WINS,
    PARENT_WINS,
    ScriptedEvaluator,
    batch_of,
    hook_of,
)

# When


def test_only_completed_episodes_count_towards_the_period(actor):
    evaluator = ScriptedEvaluator(PARENT_WINS)
    hook = hook_of(actor, evaluator, period_episodes=3)
    hook.watch.observe(batch_of("0+22", "1-33"))
    hook()
    assert hook.watch.episodes_completed == 2
    assert evaluator.num_evaluations == 0
    hook.watch.observe(batch_of("222", "333"))
    hook()
    assert evaluator.num_evaluations == 0, "steps of running episodes do not count"
    hook.watch.observe(batch_of("2+44", "333"))
    hook()
    assert evaluator.num_evaluations == 1


def test_one_evaluation_at_a_batch_boundary_however_many_periods_have_passed(actor):
    evaluator = ScriptedEvaluator(PARENT_WINS)
    hook = hook_of(actor, evaluator, period_episodes=2)
    hook.watch.observe(batch_of("0+2+4+6", "1-3-5-7"))
    assert evaluator.num_evaluations == 0, "not before the update"
    hook()
    hook()
    assert evaluator.num_evaluations == 1
    # The count starts anew at the evaluation.
    hook.watch.observe(batch_of("6+8", "77"))
    hook()
    assert evaluator.num_evaluations == 1


@pytest.mark.parametrize(
    ("episodes", "evaluations"),
    [
        ("0+1+2-3-", 1),
        ("0+1+2+3-", 1),
        ("0+1+2+3+", 0),
        ("0+1-2-3-", 0),
        ("0+1+2+3+4-", 1),
        ("0+1-2-3-4+5+", 1),
    ],
)
def test_an_evaluation_waits_until_success_is_in_its_range(episodes, evaluations, actor):
    evaluator = ScriptedEvaluator(PARENT_WINS)
    hook = hook_of(
        actor, evaluator, period_episodes=4, window_episodes=4, success_range=[0.5, 0.75]
    )
    for start in range(0, len(episodes), 2):
        hook.watch.observe(batch_of(episodes[start : start + 2]))
        hook()
    assert evaluator.num_evaluations == evaluations


def test_a_trainer_that_collects_asynchronously_is_refused(actor):
    class Asynchronous:
        async_collection = True

    with pytest.raises(ValueError, match="async_collection"):
        hook_of(actor, ScriptedEvaluator(PARENT_WINS)).register(Asynchronous())


# Who


@pytest.mark.parametrize(
    ("rule", "winner"), [("return_then_parent", 2), ("parent", 0), ("child", 1)]
)
def test_ties_are_broken_as_told(rule, winner, actor):
    evaluator = ScriptedEvaluator([5.0, 5.0, 5.0], returns=[0.1, 0.2, 0.3])
    result = hook_of(actor, evaluator, tie_rule=rule).evaluate()
    assert result.winner == winner
    assert result.switched == (winner != 0)


def test_a_population_without_a_number_keeps_the_parent(actor):
    genome = genome_of(actor)
    hook = hook_of(actor, ScriptedEvaluator([float("nan")] * 3))
    assert not hook.evaluate().switched
    assert (genome_of(actor) == genome).all()


def test_evaluations_in_which_no_fitness_is_a_number_are_counted(actor):
    nan = float("nan")
    evaluator = ScriptedEvaluator([nan, nan, nan], [nan, 1.0, nan], [nan, nan, nan])
    hook = hook_of(actor, evaluator)
    before = genome_of(actor)
    assert not hook.evaluate().switched
    assert (genome_of(actor) == before).all()
    assert hook.counts.without_fitness == 1
    assert hook.evaluate().switched
    hook.evaluate()
    assert hook.counts.without_fitness == 2
    other = hook_of(actor, ScriptedEvaluator(CHILD_WINS))
    other.load_state_dict(hook.state_dict())
    assert other.counts.without_fitness == 2


# Accounting and state


def test_population_steps_are_counted(actor):
    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS, frames=7))
    assert hook.evaluate().population_steps == 21
    hook.evaluate()
    assert hook.counts.steps == 42


def test_callbacks_hear_of_every_evaluation(actor):
    heard = []
    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS), on_evaluation=[heard.append])
    results = [hook.evaluate(), hook.evaluate()]
    assert heard == results
    assert [result.number for result in heard] == [0, 1]


def test_a_restored_hook_goes_on_identically(actor_of):
    script = (PARENT_WINS, CHILD_WINS, PARENT_WINS)
    batches = [batch_of("0+22", "111"), batch_of("2-44", "1+33"), batch_of("44", "3+5")]

    def start():
        torch.manual_seed(3)
        actor = actor_of("tanh_normal")
        return hook_of(
            actor, ScriptedEvaluator(*script), period_episodes=1, window_episodes=2
        )

    def go_on(hook, batches):
        for batch in batches:
            hook.watch.observe(batch)
            hook()

    whole = start()
    go_on(whole, batches)
    assert whole.counts.evaluations == 3
    for cut in (0, 1, 2):
        first, second = start(), start()
        go_on(first, batches[:cut])
        second.load_state_dict(first.state_dict())
        second.actor.load_state_dict(first.actor.state_dict())
        go_on(second, batches[cut:])
        expected = whole.evaluator.populations[cut:]
        for mine, other in zip(second.evaluator.populations, expected, strict=True):
            assert (mine == other).all()
        state, other = second.state_dict(), whole.state_dict()
        assert (state.pop("generator") == other.pop("generator")).all()
        assert state == other


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_children": 0}, "num_children=0"),
        ({"period_episodes": 0}, "period_episodes=0"),
        ({"success_range": [0.9, 0.2]}, "success_range="),
        ({"optimizer_on_switch": "reset"}, "optimizer_on_switch='reset'"),
        ({"critic_on_switch": "reset"}, "critic_on_switch='reset'"),
        ({"window_episodes": 0}, "window_episodes=0"),
    ],
)
def test_bad_options_are_named(options, message, actor):
    with pytest.raises(ValueError, match=message):
        hook_of(actor, ScriptedEvaluator(PARENT_WINS), **options)
