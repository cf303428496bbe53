"""Policies that a run keeps along its way: which, when, and that nothing is lost."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from gdrl_torchrl.files.evaluation import read_curve
from gdrl_torchrl.runs.kept_policies import COSTS, KeptPolicies
from gdrl_torchrl.runs.run import run_experiment


def kept_of(actor, spent, **options):
    return KeptPolicies(4, 100, actor, lambda: dict.fromkeys(COSTS, 0.0) | spent, **options)


def test_a_policy_is_kept_at_every_mark_and_none_after_the_last():
    actor, spent = nn.Linear(2, 1), {}
    kept = kept_of(actor, spent)
    weights = []
    for steps in (10, 24, 25, 49, 80, 90, 101, 140):
        spent["total_steps"] = steps
        nn.init.constant_(actor.weight, steps)
        kept()
        weights = kept.genomes()["weight"][:, 0, 0].tolist() if kept.points else []
    assert weights == [25.0, 80.0, 80.0, 101.0]
    assert [point["total_steps"] for point in kept.points] == [25, 80, 80, 101]


def test_what_the_run_would_end_with_is_kept_in_place_of_the_agent():
    elite = TensorDict(weight=torch.full((1, 2), 7.0))
    kept = kept_of(nn.Linear(2, 1), {"total_steps": 100}, result=lambda: elite)
    kept()
    elite["weight"].zero_()
    assert (kept.genomes()["weight"] == 7.0).all()
    assert kept.genomes()["bias"].shape == (4, 1)


def test_a_state_brings_them_back_but_not_those_of_another_budget():
    kept = kept_of(nn.Linear(2, 1), {"total_steps": 60})
    kept()
    other = kept_of(nn.Linear(2, 1), {"total_steps": 100})
    other.load_state_dict(kept.state_dict())
    assert (other.genomes() == kept.genomes()).all()
    other()
    assert [point["total_steps"] for point in other.points] == [60, 60, 100, 100]
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
