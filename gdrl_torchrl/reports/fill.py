"""Figures of studies within a text: each stands between two marks, and is filled in.

    PPO reached <!-- gdrl study=pilot task=near method=ppo figure=success -->0.3<!-- / -->.

Marks are comments of Markdown, so a page shows the figure alone. Nobody types a number, and
a text whose numbers are not those of the results is noticed when it is filled again.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from gdrl_torchrl.checks import check_choice
from gdrl_torchrl.files.safe_files import written_aside
from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.of_study import read_study
from gdrl_torchrl.reports.page.content import Table, count, number, p_value, with_limits
from gdrl_torchrl.reports.page.write import markdown_table
from gdrl_torchrl.reports.sections.comparison import (
    beside_baseline_table,
    by_task_table,
    summary_table,
)
from gdrl_torchrl.reports.sections.elsewhere import elsewhere_table
from gdrl_torchrl.reports.sections.hypotheses import Outcome, hypotheses_table, outcomes
from gdrl_torchrl.reports.sections.learning import at_episodes_table
from gdrl_torchrl.reports.sections.scores import costs_table, reached_table
from gdrl_torchrl.reports.statistics.averages import interquartile_mean, worst_quartile
from gdrl_torchrl.reports.statistics.bootstrap import estimate
from gdrl_torchrl.reports.statistics.probabilities import improvement_over_tasks

_BEGIN, _END = "<!-- gdrl ", "<!-- / -->"
_MARK = re.compile(rf"({_BEGIN}([^>]*?) -->)(.*?)({_END})", re.DOTALL)
_FIELDS = ("study", "task", "method", "against", "methods", "figure")

ARM_FIGURES: dict[str, Callable[[Arm], str]] = {
    "runs": lambda arm: str(len(arm.runs)),
    "score": lambda arm: number(float(arm.scores.mean())),
    "sd": lambda arm: number(float(arm.scores.std(ddof=1))),
    "iqm": lambda arm: with_limits(estimate([arm.scores], interquartile_mean)),
    "worst": lambda arm: number(worst_quartile(arm.scores)),
    "success": lambda arm: number(arm.mean("success_rate")),
    "success_sampled": lambda arm: number(arm.mean("success_rate_sampled")),
    "total_steps": lambda arm: count(arm.mean("total_steps")),
    "agent_steps": lambda arm: count(arm.mean("agent_steps")),
    "population_steps": lambda arm: count(arm.mean("population_steps")),
    "agent_episodes": lambda arm: count(arm.mean("agent_episodes")),
    "wall_s": lambda arm: count(arm.mean("wall_s")),
}
"""Of a method on a task."""
PAIR_FIGURES: dict[str, Callable[[Arm, Arm], str]] = {
    "improvement": lambda x, y: with_limits(
        improvement_over_tasks([(x.scores, y.scores)]), 2
    ),
}
"""Of two methods on a task."""
HYPOTHESIS_FIGURES: dict[str, Callable[[Outcome], str]] = {
    "difference": lambda one: with_limits(one.difference),
    "p": lambda one: p_value(one.welch_holm),
    "decision": lambda one: one.decision,
}
"""Of two methods on a task, if there is a registered hypothesis on them."""
TABLES: dict[str, Callable[[Evidence], Table]] = {
    "reached": reached_table,
    "costs": costs_table,
    "summary": summary_table,
    "by_task": by_task_table,
    "at_episodes": at_episodes_table,
    "elsewhere": elsewhere_table,
    "beside_baseline": beside_baseline_table,
}
"""Of a study, of one of its tasks, or of some of its methods (``methods=a,b``)."""


def filled(text: str, results: Path) -> str:
    """A text with all marked figures as the results of their studies give them.

    Args:
        text: Markdown; what is not between marks stays as it is.
        results: Folder of the results of studies.

    Raises:
        ValueError: If a mark names what there is not or has no end, or results are
            damaged.
    """
    study = functools.cache(lambda name: read_study(results / name))

    def fill(mark: re.Match[str]) -> str:
        # Or all up to the end of the next mark would be taken for its figure.
        if _BEGIN in mark[3]:
            raise ValueError(f"{mark[1]} must be ended by {_END}")
        try:
            figure = _figure(_fields(mark[2]), study)
        except ValueError as error:
            raise ValueError(f"{mark[1]}: {error}") from error
        return f"{mark[1]}{figure}{mark[4]}"

    rest = _MARK.sub("", text)
    if _BEGIN in rest:
        begun = rest[rest.index(_BEGIN) :].partition("\n")[0]
        raise ValueError(f"{begun} must be ended by {_END}")
    return _MARK.sub(fill, text)


def fill_files(place: Path, results: Path) -> list[Path]:
    """Fill a file of Markdown, or all below a folder.

    Returns:
        The files that have changed.

    Raises:
        ValueError: If there is none, a mark names what there is not, or results are
            damaged; no file has changed then.
        OSError: If a file cannot be read or written.
    """
    paths = sorted(place.rglob("*.md")) if place.is_dir() else [place]
    if not paths:
        raise ValueError(f"fill={place} must have files of Markdown (*.md) below it")
    changed = {}
    for path in paths:
        before = path.read_text(encoding="utf-8")
        try:
            after = filled(before, results)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        if after != before:
            changed[path] = after
    for path, text in changed.items():
        with written_aside(path) as aside:
            aside.write_text(text, encoding="utf-8")
    return list(changed)


def _fields(said: str) -> dict[str, str]:
    fields = {}
    for word in said.split():
        name, _, value = word.partition("=")
        check_choice("a field of a mark", name, _FIELDS)
        fields[name] = value
    for name in ("study", "figure"):
        if name not in fields:
            raise ValueError(f"{name}=... must be given")
    return fields


def _figure(fields: Mapping[str, str], study: Callable[[str], Evidence]) -> str:
    evidence, figure = study(fields["study"]), fields["figure"]
    if "task" in fields:
        check_choice("task", fields["task"], evidence.tasks)
    if "method" not in fields:
        if "task" in fields or "methods" in fields:
            check_choice("figure", figure, TABLES)
            table = TABLES[figure](_part(evidence, fields))
        else:
            makers = TABLES | {"hypotheses": hypotheses_table}
            check_choice("figure", figure, makers)
            table = makers[figure](evidence)
        return f"\n\n{markdown_table(table.columns, table.rows)}\n\n"
    if "task" not in fields:
        raise ValueError("task=... must be given beside method=")
    arms = [
        _arm(evidence, fields["task"], fields[name], name)
        for name in ("method", "against")
        if name in fields
    ]
    if len(arms) == 1:
        check_choice("figure", figure, ARM_FIGURES)
        return ARM_FIGURES[figure](arms[0])
    check_choice("figure", figure, [*PAIR_FIGURES, *HYPOTHESIS_FIGURES])
    if figure in PAIR_FIGURES:
        return PAIR_FIGURES[figure](arms[0], arms[1])
    return HYPOTHESIS_FIGURES[figure](_outcome(evidence, *arms))


def _part(evidence: Evidence, fields: Mapping[str, str]) -> Evidence:
    if "methods" in fields:
        methods = fields["methods"].split(",")
        for method in methods:
            check_choice("methods", method, evidence.methods)
        evidence = evidence.of_methods(methods)
    return evidence.on(fields["task"]) if "task" in fields else evidence


def _arm(evidence: Evidence, task: str, method: str, field: str) -> Arm:
    arms = {arm.method: arm for arm in evidence.of_task(task)}
    check_choice(field, method, arms)
    return arms[method]


def _outcome(evidence: Evidence, method: Arm, against: Arm) -> Outcome:
    pair = (method.task, method.method, against.method)
    for one in outcomes(evidence):
        found = one.hypothesis
        if (found.task, found.method, found.against) == pair:
            return one
    raise ValueError(
        f"{method.method} against {against.method} on {method.task} must be a registered "
        "hypothesis of the study"
    )
