"""Watching the agent: which episodes count, in which order, and after a restart."""

from __future__ import annotations

import pytest

from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.runs.build import build_training
from tests.evolution.hooks.scripted import (
    CHILD_WINS,
    PARENT_WINS,
    ScriptedEvaluator,
    batch_of,
    hook_of,
)


def test_a_watch_counts_by_itself():
    watch = EpisodeWatch()
    watch.observe(batch_of("0+2+4+6", "1-3-5-7"))
    assert watch.episodes_completed == 6
    assert watch.window.running_rate == 0.5
    other = EpisodeWatch()
    other.load_state_dict(watch.state_dict())
    other.observe(batch_of("6+8", "77"))
    assert other.episodes_completed == 7


def test_a_bare_agent_has_a_watch_and_no_hook(tiny):
    training = build_training(tiny("evolution=none"))
    training.loop.register_op("post_steps", training.loop.request_stop)
    training.loop.train()
    assert training.evolution is None
    assert training.watch.episodes_completed >= 1
    training.close()


def test_success_is_counted_in_the_order_of_the_start(actor):
    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS), window_episodes=2)
    hook.watch.observe(batch_of("000", "1+22", "444"))
    assert hook.watch.window.running_rate is None, "episode 0 is still running"
    hook.watch.observe(batch_of("0-55", "2-66", "444"))
    # 0 failed, 1 succeeded, 2 failed: the last two of these.
    assert hook.watch.window.rate == 0.5


def test_the_window_survives_a_switch(actor):
    hook = hook_of(actor, ScriptedEvaluator(CHILD_WINS), window_episodes=2)
    hook.watch.observe(batch_of("0+2", "1+3"))
    assert hook.evaluate().switched
    assert hook.watch.window.rate == 1.0


@pytest.mark.parametrize("trajectories_from", ["environment", "collector"])
def test_episodes_numbered_anew_after_a_restart_do_not_stop_it(trajectories_from, actor):
    def batch(*worlds):
        made = batch_of(*worlds)
        if trajectories_from == "collector":
            made["collector", "traj_ids"] = made.pop("episode_number")[..., 0]
        return made

    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS), window_episodes=2)
    hook.watch.observe(batch("0+22", "1-33"))
    restored = hook_of(actor, ScriptedEvaluator(PARENT_WINS), window_episodes=2)
    restored.load_state_dict(hook.state_dict())
    # The episodes that were running are gone; new ones begin with number 0.
    restored.watch.observe(batch("0+22", "1+33"))
    assert restored.watch.episodes_completed == 4
    assert restored.watch.window.rate == 1.0


def test_an_old_episode_that_waits_for_others_is_not_one_that_is_numbered_anew(actor):
    watch = hook_of(actor, ScriptedEvaluator(PARENT_WINS)).watch
    # Episode 1 has ended and waits for 0, which never ends: the process was killed.
    watch.observe(batch_of("0", "1+"))
    watch.observe(batch_of("0+1+", "22"))
    assert watch.episodes_completed == 3
