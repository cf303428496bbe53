"""Policies unlike our own score as a plain loop would score them, or are refused."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from tests.contracts.policies import CASES, Case

MEMBERS, SEEDS, STEPS = 3, (11, 12), 40
PAGE = Path(__file__).parents[2] / "docs" / "extending" / "policies.md"
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"
TOLERANCE = 1e-4


def population_of(actor):
    genomes = stack_copies(genome_of(actor, exclude=()), MEMBERS)
    generator = torch.Generator().manual_seed(1)
    for leaf in genomes.values(True, True):
        leaf[1:] += 0.7 * torch.randn(leaf[1:].shape, generator=generator, dtype=leaf.dtype)
    return genomes


def plain_loop(case, env, genomes):
    """Rewards and actions of every member and episode, one after the other."""
    found = []
    # As many as there are members, each made anew.
    members = [_made(case)[0] for _ in range(MEMBERS)]
    torch.manual_seed(2)
    for number, member in enumerate(members):
        parameters = dict(member.named_parameters())
        with torch.no_grad():
            for path, value in genomes[number].items(True, True):
                parameters[".".join(path)].copy_(value)
        for seed in SEEDS:
            env.set_seed(seed)
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                path = env.rollout(STEPS, member).reshape(-1)
            actions = [path[key].reshape(len(path), -1).double() for key in env.action_keys]
            found.append((path["next", "reward"].flatten(), torch.cat(actions, dim=1)))
    return found


def table_row(case: Case) -> tuple[str, str, float]:
    """How a case is run, and the largest difference from the plain loop."""
    actor, env = _made(case)
    genomes = population_of(actor)
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    evaluator = PopulationEvaluator(
        actor, create_env_fn=lambda: env, num_episodes=2, max_steps=STEPS, fitness="return"
    )
    seeds = torch.tensor(SEEDS)
    if case.refusal is not None:
        with pytest.raises((ValueError, RuntimeError), match=case.refusal) as error:
            evaluator.evaluate(genomes, seeds=seeds)
        return "refused", str(error.value), 0.0
    torch.manual_seed(2)
    scores, steps = evaluator.evaluate_with_transitions(genomes, seeds=seeds)
    expected = plain_loop(case, env, genomes)
    for name, value in actor.state_dict().items():
        assert torch.equal(value, before[name]), f"{name} of the user's policy was written"
    largest = 0.0
    for number, (reward, action) in enumerate(expected):
        member, episode = divmod(number, len(SEEDS))
        mine = steps[(steps["member"] == member) & (steps["episode"] == episode)]
        assert len(mine) == len(reward) == scores["steps"][member, episode]
        acted = [mine[key].reshape(len(mine), -1).double() for key in env.action_keys]
        for one, other in (
            (torch.cat(acted, dim=1), action),
            (mine["next", "reward"].flatten(), reward),
            (scores["returns"][member, episode], reward.sum()),
        ):
            largest = max(largest, float((one - other).abs().max()))
    assert torch.isfinite(scores["fitness"]).all()
    acted = {tuple(action.flatten().tolist()) for _, action in expected}
    assert len(acted) >= MEMBERS, "members must differ to tell"
    env.close()
    reason = evaluator.population.reason
    return ("one by one" if reason else "as a batch"), reason, largest


def _made(case):
    torch.manual_seed(0)
    return case.make()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_policy_scores_as_in_a_plain_loop_or_is_refused_by_name(case):
    way, reason, largest = table_row(case)
    assert largest <= TOLERANCE
    written = dict(_rows(PAGE.read_text()))
    if os.environ.get("UPDATE_DOCS"):
        written[case.name] = _cells(way, reason, largest)
        _write(written)
    assert case.name in written, "UPDATE_DOCS=1 makes the page's table anew"
    expected = _cells(way, reason, largest)
    assert written[case.name][:2] == expected[:2], "UPDATE_DOCS=1 makes the table anew"
    # Rounding differs between machines.
    assert largest <= max(100.0 * float(written[case.name][2] or 0.0), 1e-6)


def _cells(way, reason, largest):
    reason = re.sub(r"\s+", " ", reason).replace("|", "\\|")
    return way, reason, "" if way == "refused" else f"{largest:.0e}".replace("0e+00", "0")


def _rows(page):
    table = page[page.index(BEGIN) + len(BEGIN) : page.index(END)]
    for line in table.splitlines()[2:]:
        name, *cells = (cell.strip() for cell in line.strip("|").split(" | "))
        yield name, tuple(cells)


def _write(rows):
    page = PAGE.read_text()
    lines = [
        "| policy | members act | why; or the error | largest difference |",
        "|---|---|---|---|",
    ]
    names = [case.name for case in CASES if case.name in rows]
    lines += [f"| {name} | {' | '.join(rows[name])} |" for name in names]
    before, rest = page.split(BEGIN)
    PAGE.write_text(before + BEGIN + "\n".join(lines) + "\n" + END + rest.split(END)[1])
