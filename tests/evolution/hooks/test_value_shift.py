"""How far a switch moves the values that the policy gives."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.evolution.hooks.scripted import (
    CHILD_WINS,
    PARENT_WINS,
    ScriptedEvaluator,
    hook_of,
)


@pytest.mark.parametrize("kind", ["q_value", "distributional"])
def test_a_switch_says_how_far_it_moves_the_values(kind, actor_of):
    actor = actor_of(kind)
    hook = hook_of(actor, ScriptedEvaluator(CHILD_WINS, PARENT_WINS))
    rows = TensorDict(observation=torch.rand(4, 5, 3), batch_size=[4, 5])
    hook.value_shift.observe(rows)

    @torch.no_grad()
    def values():
        return actor(rows.select("observation").clone())["action_value"]

    def expected(shown):
        # Of a distribution over returns, the mean.
        return shown if kind == "q_value" else shown.softmax(-2).movedim(-2, -1) @ support

    support = getattr(actor, "support", None)
    before = expected(values())
    found = hook.evaluate()
    after = expected(values())
    spread = before.std()
    assert found.switched
    assert found.value_shift == pytest.approx(
        float((after - before).square().mean().sqrt() / spread), rel=1e-4
    )
    assert found.value_shift > 0.0
    assert hook.evaluate().value_shift is None, "no switch, no shift"


def test_a_policy_without_values_has_no_shift(actor):
    hook = hook_of(actor, ScriptedEvaluator(CHILD_WINS))
    hook.value_shift.observe(TensorDict(observation=torch.rand(4, 5, 3), batch_size=[4, 5]))
    found = hook.evaluate()
    assert found.switched
    assert found.value_shift is None
