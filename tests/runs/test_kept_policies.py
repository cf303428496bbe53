"""Policies that a run keeps along its way: which, when, and that nothing is lost."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from gdrl_torchrl.agents.loop import TrainingLoop
from gdrl_torchrl.files.evaluation import read_curve
from gdrl_torchrl.runs.kept_policies import COSTS, KeptPolicies
from gdrl_torchrl.runs.run import run_experiment


def kept_of(actor, spent, **options):
    return KeptPolicies(4, 100, actor, lambda: dict.fromkeys(COSTS, 0.0) | spent, **options)


def train(kept, actor, spent, *steps):
    for now in steps:
        spent["total_steps"] = now
        nn.init.constant_(actor.weight, now)
        kept()


@pytest.mark.parametrize(
    ("steps", "had"),
    [
        # The mark at 25 is met; 50 and 75 are passed at once, by what is known at 80 only.
        ((10, 24, 25, 49, 80, 90, 101, 140), [25, 49, 49, 90]),
        # At 100 the budget ends, and so may the run.
        ((30, 60, 80, 100), [0, 30, 60, 100]),
        ((130,), [0, 0, 0, 0]),
        # Of two policies with as many steps the first is kept where they meet a mark.
        ((20, 50, 50, 51, 51, 120), [20, 50, 51, 51]),
    ],
)
def test_for_every_mark_the_policy_is_kept_that_the_run_had_by_then(steps, had):
    actor, spent = nn.Linear(2, 1), {}
    nn.init.constant_(actor.weight, 0.0)
    kept = kept_of(actor, spent)
    train(kept, actor, spent, *steps)
    assert kept.genomes()["weight"][:, 0, 0].tolist() == had
    assert [point["total_steps"] for point in kept.points] == had
    # Numbers of steps are whole ones, or a curve's file is refused.
    assert all(isinstance(point["total_steps"], int) for point in kept.points)


def test_a_contest_that_passes_a_mark_leaves_it_the_policy_of_before_the_contest():
    actor, spent, loop = nn.Linear(2, 1), {}, TrainingLoop()
    kept = kept_of(actor, spent)
    kept.register(loop)
    for stage, steps in (("post_optim", 20), ("post_steps", 90), ("post_optim", 110)):
        spent["total_steps"] = steps
        nn.init.constant_(actor.weight, steps)
        loop._call(stage)
    assert kept.genomes()["weight"][:, 0, 0].tolist() == [20.0, 20.0, 20.0, 90.0]


def test_what_the_run_would_end_with_is_kept_in_place_of_the_agent():
    elite = TensorDict(weight=torch.full((1, 2), 7.0))
    kept = kept_of(nn.Linear(2, 1), {"total_steps": 101}, result=lambda: elite)
    kept()
    elite["weight"].zero_()
    assert (kept.genomes()["weight"] == 7.0).all()
    assert kept.genomes()["bias"].shape == (4, 1)


def test_a_state_brings_them_back_but_not_those_of_another_budget():
    actor, spent = nn.Linear(2, 1), {}
    kept = kept_of(actor, spent)
    train(kept, actor, spent, 20, 60)
    other = kept_of(nn.Linear(2, 1), {"total_steps": 101})
    other.load_state_dict(kept.state_dict())
    assert (other.genomes() == kept.genomes()).all()
    other()
    assert [point["total_steps"] for point in other.points] == [20, 20, 60, 60]
    assert other.genomes()["weight"][:, 0, 0].tolist() == [20.0, 20.0, 60.0, 60.0]
    longer = KeptPolicies(4, 200, nn.Linear(2, 1), dict)
    with pytest.raises(ValueError, match=r"budget\.total_steps=200 must be 100"):
        longer.load_state_dict(kept.state_dict())


@pytest.mark.full
def test_an_interrupted_run_keeps_what_an_uninterrupted_one_keeps(
    tiny_of_each, tmp_path, without_figures
):
    options = ("budget.total_steps=400", "evaluation.num_policies=5")
    whole = tiny_of_each(
        "budget.agent_steps=null", *options, f"runs_dir={tmp_path / 'whole'}"
    )
    for steps in (80, 120):
        pieces = run_experiment(
            tiny_of_each(
                f"budget.agent_steps={steps}", *options, f"runs_dir={tmp_path / 'pieces'}"
            )
        )
    pieces = run_experiment(
        tiny_of_each("budget.agent_steps=null", *options, f"runs_dir={tmp_path / 'pieces'}")
    )
    mine, other = read_curve(pieces), read_curve(run_experiment(whole))
    assert [point["point"] for point in other] == [1, 2, 3, 4, 5]
    for point in (*mine, *other):
        assert point.pop("wall_s") > 0.0
    assert mine == other


def test_keeping_policies_changes_nothing_that_is_learnt(
    tiny, tmp_path, evaluation_of, without_figures
):
    digests = [
        evaluation_of(
            run_experiment(
                tiny(
                    *("budget.agent_steps=null", "budget.total_steps=300"),
                    *(
                        f"evaluation.num_policies={count}",
                        f"runs_dir={tmp_path / str(count)}",
                    ),
                )
            )
        )["params_sha256"]
        for count in (0, 3)
    ]
    assert digests[0] == digests[1]


def test_kept_policies_need_a_budget_of_total_steps(tiny):
    with pytest.raises(ValueError, match=r"num_policies=3 needs budget\.total_steps"):
        run_experiment(tiny("evaluation.num_policies=3"))
