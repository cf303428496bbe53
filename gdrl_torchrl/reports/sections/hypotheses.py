"""The comparisons that were registered before the runs, and what came of them."""

from __future__ import annotations

import dataclasses
import functools
import math

from gdrl_torchrl.reports.evidence import Evidence, Hypothesis
from gdrl_torchrl.reports.page.content import (
    Section,
    Table,
    Text,
    number,
    p_value,
    with_limits,
)
from gdrl_torchrl.reports.statistics.bootstrap import Estimate
from gdrl_torchrl.reports.statistics.comparisons import (
    detectable_difference,
    holm,
    permutation_p,
    welch,
)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """A hypothesis with its tests.

    Attributes:
        hypothesis: What was registered.
        runs: Numbers of runs of its methods.
        difference: Of mean scores, with its 95 % interval.
        welch_p: Of Welch's test; NaN where there is nothing to test by.
        permutation_p: Of the permutation test.
        welch_holm: ``welch_p`` adjusted for the number of hypotheses.
        permutation_holm: ``permutation_p`` adjusted.
        detectable: Difference that would be found with a power of 0.8.
        is_whole: Whether all registered runs are there.
        alpha: Level of all tests together.
    """

    hypothesis: Hypothesis
    runs: tuple[int, int]
    difference: Estimate
    welch_p: float
    permutation_p: float
    welch_holm: float
    permutation_holm: float
    detectable: float
    is_whole: bool
    alpha: float

    @property
    def decision(self) -> str:
        """What may be said of the hypothesis."""
        if math.isnan(self.welch_holm):
            return "cannot be tested with these runs"
        text = "not supported"
        if self.welch_holm <= self.alpha:
            least = self.hypothesis.least_difference
            text = "supported"
            # Its direction is that of the test.
            if abs(self.difference.value) < least:
                text = f"a difference, but less than the {least:g} that would matter"
            elif not self.permutation_holm <= self.alpha:
                text = "supported by Welch's test, not by the permutation test"
        return text if self.is_whole else f"preliminary, runs are missing: {text}"


@functools.cache
def outcomes(evidence: Evidence) -> list[Outcome]:
    """All registered hypotheses with their tests."""
    found = []
    for hypothesis in evidence.hypotheses:
        arms = [
            evidence.arm(hypothesis.task, method)
            for method in (hypothesis.method, hypothesis.against)
        ]
        x, y = arms[0].scores, arms[1].scores
        alternative = hypothesis.alternative
        enough = min(len(x), len(y)) >= 2
        difference, p = (
            welch(x, y, alternative) if enough else (Estimate(math.nan), math.nan)
        )
        found.append(
            Outcome(
                hypothesis,
                (len(x), len(y)),
                difference,
                p,
                permutation_p(x, y, alternative) if enough else math.nan,
                math.nan,
                math.nan,
                detectable_difference(
                    x, y, alternative, alpha=evidence.alpha / len(evidence.hypotheses)
                ),
                not any(arm.missing for arm in arms),
                evidence.alpha,
            )
        )
    adjusted = zip(
        holm([one.welch_p for one in found]),
        holm([one.permutation_p for one in found]),
        strict=True,
    )
    return [
        dataclasses.replace(one, welch_holm=welch_p, permutation_holm=perm_p)
        for one, (welch_p, perm_p) in zip(found, adjusted, strict=True)
    ]


def hypotheses_table(evidence: Evidence) -> Table:
    """Differences, tests and decisions."""
    name = evidence.words.score_name
    return Table(
        f"Registered hypotheses: difference of mean {name} with its 95 % interval (Welch), "
        "p of Welch's and of the permutation test, and both after Holm's adjustment",
        (
            "hypothesis",
            "task",
            "difference",
            "Welch p",
            "permutation p",
            "Welch, Holm",
            "permutation, Holm",
            "decision",
        ),
        [
            (
                _said(one.hypothesis),
                one.hypothesis.task,
                with_limits(one.difference),
                p_value(one.welch_p),
                p_value(one.permutation_p),
                p_value(one.welch_holm),
                p_value(one.permutation_holm),
                one.decision,
            )
            for one in outcomes(evidence)
        ],
    )


def _power_table(evidence: Evidence) -> Table:
    return Table(
        "What these runs could show: the difference that Welch's test would find with "
        f"probability 0.8, with this scatter, at {evidence.alpha:g} over the number of "
        "hypotheses",
        ("hypothesis", "runs", "difference that would be found", "that would matter"),
        [
            (
                _said(one.hypothesis),
                f"{one.runs[0]} and {one.runs[1]}",
                number(one.detectable),
                number(one.hypothesis.least_difference),
            )
            for one in outcomes(evidence)
        ],
    )


def hypotheses_section(evidence: Evidence) -> Section:
    """What came of them, and what these runs could have shown."""
    rule = Text(
        "A hypothesis is supported if Welch's test rejects equal means at the level "
        f"{evidence.alpha:g} after Holm's adjustment for all hypotheses in this table, and "
        "the difference is at least the one that would matter."
    )
    tables = (hypotheses_table(evidence), _power_table(evidence))
    return Section("hypotheses", "Registered hypotheses", (rule, *tables))


def _said(hypothesis: Hypothesis) -> str:
    sign = {"greater": ">", "less": "<", "two-sided": "≠"}[hypothesis.alternative]
    return f"{hypothesis.name}: {hypothesis.method} {sign} {hypothesis.against}"
