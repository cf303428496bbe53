"""What makes children: the rate of mutation, the part that mutates, the population."""

from __future__ import annotations

import pytest
import torch

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren, breeding_of
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.settings import EvolutionConfig
from tests.evolution.hooks.scripted import PARENT_WINS, ScriptedEvaluator, batch_of, hook_of


def test_mutation_follows_the_success_of_the_window(actor):
    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS), window_episodes=2)
    assert hook.evaluate().mut_p == 0.75, "until the window is full"
    hook.watch.observe(batch_of("0+2", "1+3"))
    assert hook.evaluate().mut_p == 0.1
    hook.watch.observe(batch_of("2-4", "3+5"))
    assert hook.evaluate().mut_p == 0.4


def test_mutation_may_follow_the_agents_copy_in_the_last_contest(actor):
    script = [9.0, 0.0, 0.0], [5.0, 10.0, 0.0], [1.0, 0.0, 0.0]
    hook = hook_of(actor, ScriptedEvaluator(*script), rate_of="contest")
    hook.watch.observe(batch_of("0+2", "1+3"))
    # Nothing is known at first; a child that wins does not count.
    assert [hook.evaluate().mut_p for _ in range(3)] == [0.75, 0.1, 0.4]
    other = hook_of(actor, ScriptedEvaluator(*script), rate_of="contest")
    other.load_state_dict(hook.state_dict())
    assert other.evaluate().mut_p == 0.75, "0.1 in the last contest"


@pytest.mark.parametrize("part", ["head", "advantage"])
def test_only_a_part_mutates_if_asked_for(part, actor_of):
    actor = actor_of("distributional")
    settings = EvolutionConfig(genome=part, rates=[1.0, 1.0, 1.0])
    genome = genome_of(actor)
    brood = breeding_of(settings, actor)(
        genome, None, generator=torch.Generator().manual_seed(0)
    )
    changed = {
        ".".join(path)
        for path, leaf in brood.genomes.items(True, True)
        if (leaf != genome[path]).any()
    }
    stream = {".".join(path) for path in genome.keys(True, True) if "advantage" in path}
    assert changed == stream if part == "advantage" else changed < stream
    assert changed


def test_a_part_that_a_policy_has_not_is_refused(actor):
    breeding = breeding_of(EvolutionConfig(genome="advantage"), actor)
    with pytest.raises(ValueError, match="genome='advantage': the policy has no stream"):
        breeding(genome_of(actor), None, generator=torch.Generator())


def test_member_0_is_the_parent_and_the_children_are_mutants_of_it(actor):
    evaluator = ScriptedEvaluator(PARENT_WINS)
    genome = genome_of(actor)
    hook_of(actor, evaluator).evaluate()
    population = evaluator.populations[0]
    assert population.batch_size == torch.Size([3])
    assert (population[0] == genome).all()
    for child in (1, 2):
        assert not (population[child] == genome).all()
    assert not (population[1] == population[2]).all()


def test_the_mutation_gets_the_schedules_rate_and_the_given_noise(actor):
    seen = {}

    def mutation(genomes, **options):
        seen.update(options)
        return genomes

    breeding = MutatedChildren(2, mutation=mutation, std=0.3)
    hook_of(actor, ScriptedEvaluator(PARENT_WINS), breeding).evaluate()
    assert (seen["mut_p"], seen["std"]) == (0.75, 0.3)
