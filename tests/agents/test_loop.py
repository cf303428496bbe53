"""The loop that trains agents."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl.agents.loop import STAGES, TrainingLoop
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch


class Collector:
    """Batches ``[2, 3]`` that count, without end."""

    def __iter__(self):
        number = 0
        while True:
            yield TensorDict(number=torch.full((2, 3), number), batch_size=[2, 3])
            number += 1


class Learner:
    """Notes what it learns from."""

    updates = ()

    def __init__(self, calls):
        self.calls = calls

    def learn(self, batch):
        self.calls.append(("learn", int(batch["number"][0, 0])))


def test_without_a_collector_hooks_are_called_in_order_until_one_asks_to_stop():
    loop, calls = TrainingLoop(), []
    loop.register_op("batch_process", lambda batch: calls.append("no batches here"))
    loop.register_op("post_steps", lambda: calls.append("a"))
    loop.register_op("post_steps", lambda: len(calls) > 4 and loop.request_stop())
    loop.register_op("post_steps", lambda: calls.append("b"))
    loop.train()
    assert calls == ["a", "b"] * 3
    loop.train()
    assert calls == ["a", "b"] * 4


def test_a_step_collects_learns_and_calls_the_stages_in_order():
    calls = []
    loop = TrainingLoop(Learner(calls), Collector())
    for stage in STAGES:
        loop.register_op(stage, lambda *batch, stage=stage: calls.append(stage))
    loop.register_op(
        "post_steps", lambda: loop.collected_frames == 12 and loop.request_stop()
    )
    loop.train()
    step = ["batch_process", "pre_steps_log", "learn", "post_optim", "post_steps"]
    numbered = [
        [("learn", n) if name == "learn" else name for name in step] for n in (0, 1)
    ]
    assert calls == [*numbered[0], *numbered[1]]


def test_what_a_hook_makes_of_a_batch_is_learnt_from():
    calls = []
    loop = TrainingLoop(Learner(calls), Collector())
    loop.register_op("batch_process", lambda batch: None)
    loop.register_op(
        "batch_process", lambda batch: batch.set("number", batch["number"] + 7)
    )
    loop.register_op("post_steps", loop.request_stop)
    loop.train()
    assert calls == [("learn", 7)]


def test_a_stage_that_is_none_is_refused_by_name():
    with pytest.raises(ValueError, match="'pre_optim' must be one of"):
        TrainingLoop().register_op("pre_optim", print)


def test_an_error_of_the_learner_ends_training_with_the_frames_counted():
    class Fails(Learner):
        def learn(self, batch):
            raise FloatingPointError("no number")

    loop = TrainingLoop(Fails([]), Collector())
    with pytest.raises(FloatingPointError, match="no number"):
        loop.train()
    assert loop.collected_frames == 6


def test_hooks_of_torchrl_trainers_serve_the_loop():
    done = torch.tensor([[False, True]])
    batch = TensorDict(
        next=TensorDict(done=done, success=done, batch_size=[1, 2]),
        episode_number=torch.tensor([[3, 3]]),
        batch_size=[1, 2],
    )
    loop, watch = TrainingLoop(None, [batch]), EpisodeWatch(1)
    watch.register(loop)
    loop.train()
    assert (watch.episodes_completed, watch.window.rate) == (1, 1.0)
