"""The protocol of a study: what it fixes, and what is refused."""

from __future__ import annotations

import pytest

from gdrl_torchrl.config.study import Hypothesis, StudyMethod
from gdrl_torchrl.studies.protocol import jobs_of, protocol_of, protocol_sha256
from tests.small import toy_study


def test_every_method_is_run_with_every_seed_and_early_results_are_of_all():
    jobs = [(job.task, job.method, job.seed) for job in jobs_of(toy_study())]
    arms = [("easy", "gppo"), ("easy", "ppo")]
    assert jobs == [(*arm, seed) for seed in (3, 4) for arm in arms]


@pytest.mark.parametrize(
    "changed",
    [
        {"seeds": [3]},
        {"episodes": 4},
        {"alpha": 0.1},
        {"hypotheses": []},
        {"elsewhere": {"easy": {"rough": ["task.sea=rough"]}}},
        {"baseline": {"easy": "ppo"}},
        {"total_steps": {"easy": 401}},
        {
            "methods": {"ppo": StudyMethod(["easy"], ["experiment=ppo_water"])},
            "hypotheses": [],
        },
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_whatever_changes_makes_it_another_protocol(changed):
    def digest(**options):
        return protocol_sha256(protocol_of(toy_study(**options)))

    assert digest() == digest()
    assert digest(**changed) != digest()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"seeds": [1, 1]}, r"study\.seeds=\[1, 1\] must not hold a seed twice"),
        ({"seeds": []}, r"study\.seeds=\[\] must be a list of 1 to"),
        ({"methods": {}}, r"study\.methods=\{\} must not be empty"),
        ({"methods": {"x": StudyMethod([], [])}}, r"study\.methods\.x\.tasks=\[\]"),
        ({"methods": {"x": StudyMethod(["far"], [])}}, "'far' must be one of"),
        ({"total_steps": {}}, "'easy' must be one of"),
        ({"tasks": {"a/b": []}, "total_steps": {"a/b": 9}}, "must be a folder's name"),
        (
            {"hypotheses": [Hypothesis("h", "easy", "gppo", "pop")]},
            "h.against='pop' must be",
        ),
        ({"hypotheses": [Hypothesis("h", "far", "gppo", "ppo")]}, "h.task='far' must be"),
        ({"baseline": {"far": "ppo"}}, r"study\.baseline='far' must be one of"),
        ({"baseline": {"easy": "x"}}, r"study\.baseline\.easy='x' must be one of"),
        ({"elsewhere": {"far": {}}}, r"study\.elsewhere='far' must be one of"),
        ({"elsewhere": {"easy": {"a/b": []}}}, r"elsewhere\.easy='a/b' must be a folder's"),
    ],
)
def test_what_cannot_be_run_or_tested_is_refused(changed, told):
    with pytest.raises(ValueError, match=told):
        toy_study(**changed)
