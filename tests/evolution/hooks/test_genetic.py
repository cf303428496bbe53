"""The genetic hook: when it evaluates, who wins, and what a switch touches."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import GymEnv
from torchrl.modules import (
    MLP,
    ActorValueOperator,
    OneHotCategorical,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren, breeding_of
from gdrl_torchrl.evolution.hooks.contest import FullContest, contest_of
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.hand_over import hand_over_of
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.settings import EvolutionConfig
from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import seed_everything


class ScriptedEvaluator:
    """Gives scores from a list, and keeps the populations that it was shown."""

    def __init__(self, *fitness, returns=None, frames=7):
        self.fitness, self.returns, self.frames = list(fitness), returns, frames
        self.populations = []
        # A hook restores it, so it is what the script goes by.
        self.episodes_drawn = 0

    @property
    def num_evaluations(self):
        return self.episodes_drawn

    def evaluate(self, population, *, seeds=None):
        scores = torch.tensor(self.fitness[self.num_evaluations % len(self.fitness)])
        self.episodes_drawn += 1
        self.populations.append(population.clone())
        count = population.batch_size[0]
        assert scores.shape == (count,)
        returns = torch.zeros(count) if self.returns is None else torch.tensor(self.returns)
        return TensorDict(
            fitness=scores,
            success_rate=scores / 10.0,
            return_mean=returns,
            frames=torch.full((count,), self.frames),
            batch_size=[count],
        )

    def close(self):
        pass


PARENT_WINS, CHILD_WINS = [5.0, 1.0, 1.0], [1.0, 1.0, 5.0]


@pytest.fixture
def actor(actor_of):
    return actor_of("tanh_normal")


def hook_of(
    actor,
    evaluator,
    breeding=None,
    *,
    optimizer=None,
    critic=None,
    on_evaluation=(),
    **settings,
):
    """A hook of two children, whose parts have these settings."""
    settings = EvolutionConfig(**{"num_children": 2, "period_episodes": 4} | settings)
    return GeneticHook(
        actor,
        evaluator,
        breeding or breeding_of(settings, actor),
        contest_of(settings),
        hand_over_of(settings, actor, optimizer=optimizer, critic=critic),
        watch=EpisodeWatch(settings.window_episodes),
        period_episodes=settings.period_episodes,
        rate_of=settings.rate_of,
        on_evaluation=on_evaluation,
    )


def batch_of(*worlds):
    """A batch ``[W, T]`` from strings: a digit is a step of that episode; ``+`` and
    ``-`` after it end the episode with and without success."""
    rows = []
    for world in worlds:
        steps = []
        for symbol in world:
            if symbol in "+-":
                steps[-1] = (steps[-1][0], True, symbol == "+")
            else:
                steps.append((int(symbol), False, False))
        rows.append(steps)
    number, done, success = (
        torch.tensor([[step[i] for step in row] for row in rows])[..., None]
        for i in range(3)
    )
    size = number.shape[:2]
    following = TensorDict(done=done, success=success, batch_size=size)
    return TensorDict(episode_number=number, next=following, batch_size=size)


# When


def test_only_completed_episodes_count_towards_the_period(actor):
    evaluator = ScriptedEvaluator(PARENT_WINS)
    hook = hook_of(actor, evaluator, period_episodes=3)
    hook.watch.observe(batch_of("0+22", "1-33"))
    hook()
    assert hook.watch.episodes_completed == 2
    assert evaluator.num_evaluations == 0
    hook.watch.observe(batch_of("222", "333"))
    hook()
    assert evaluator.num_evaluations == 0, "steps of running episodes do not count"
    hook.watch.observe(batch_of("2+44", "333"))
    hook()
    assert evaluator.num_evaluations == 1


def test_one_evaluation_at_a_batch_boundary_however_many_periods_have_passed(actor):
    evaluator = ScriptedEvaluator(PARENT_WINS)
    hook = hook_of(actor, evaluator, period_episodes=2)
    hook.watch.observe(batch_of("0+2+4+6", "1-3-5-7"))
    assert evaluator.num_evaluations == 0, "not before the update"
    hook()
    hook()
    assert evaluator.num_evaluations == 1
    # The count starts anew at the evaluation.
    hook.watch.observe(batch_of("6+8", "77"))
    hook()
    assert evaluator.num_evaluations == 1


def test_a_trainer_that_collects_asynchronously_is_refused(actor):
    class Asynchronous:
        async_collection = True

    with pytest.raises(ValueError, match="async_collection"):
        hook_of(actor, ScriptedEvaluator(PARENT_WINS)).register(Asynchronous())


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


def test_the_window_survives_a_switch(actor):
    hook = hook_of(actor, ScriptedEvaluator(CHILD_WINS), window_episodes=2)
    hook.watch.observe(batch_of("0+2", "1+3"))
    assert hook.evaluate().switched
    assert hook.watch.window.rate == 1.0


# Who


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


@pytest.mark.parametrize(
    ("rule", "winner"), [("return_then_parent", 2), ("parent", 0), ("child", 1)]
)
def test_ties_are_broken_as_told(rule, winner, actor):
    evaluator = ScriptedEvaluator([5.0, 5.0, 5.0], returns=[0.1, 0.2, 0.3])
    result = hook_of(actor, evaluator, tie_rule=rule).evaluate()
    assert result.winner == winner
    assert result.switched == (winner != 0)


def test_a_population_without_a_number_keeps_the_parent(actor):
    genome = genome_of(actor)
    hook = hook_of(actor, ScriptedEvaluator([float("nan")] * 3))
    assert not hook.evaluate().switched
    assert (genome_of(actor) == genome).all()


# What a switch does


def test_the_winner_is_written_into_the_same_parameter_objects(actor):
    evaluator = ScriptedEvaluator(CHILD_WINS)
    objects = {name: id(value) for name, value in actor.named_parameters()}
    scale = actor.module[0].module[-1].state_independent_scale.clone()
    hook = hook_of(actor, evaluator)
    result = hook.evaluate()
    assert result.winner == 2
    assert {name: id(value) for name, value in actor.named_parameters()} == objects
    assert (genome_of(actor) == evaluator.populations[0][2]).all()
    assert (actor.module[0].module[-1].state_independent_scale == scale).all()
    assert (hook.counts.evaluations, hook.counts.switches) == (1, 1)


def test_a_parent_that_wins_is_left_alone(actor):
    genome = genome_of(actor)
    optimizer = torch.optim.Adam(actor.parameters())
    take_a_step(actor, optimizer, weight=0.0)
    hook = hook_of(
        actor,
        ScriptedEvaluator(PARENT_WINS),
        optimizer=optimizer,
        optimizer_on_switch="reset",
    )
    moments = len(optimizer.state)
    assert not hook.evaluate().switched
    assert (genome_of(actor) == genome).all()
    assert len(optimizer.state) == moments > 0
    assert hook.counts.switches == 0


def take_a_step(module, optimizer, *, weight=1.0):
    optimizer.zero_grad()
    sum(weight * p.square().sum() for p in module.parameters()).backward()
    optimizer.step()


@pytest.mark.parametrize("choice", ["keep", "reset"])
def test_the_moments_of_the_actor_alone_are_reset_on_a_switch(choice, tiny):
    seed_everything(0)
    training = build_training(tiny(f"evolution.optimizer_on_switch={choice}"))
    training.agent.learner.learn(next(iter(training.agent.collector)))
    optimizer, hook = training.agent.optimizer, training.evolution
    actor = {id(p) for p in training.agent.actor.parameters()}
    before = {id(p) for p in optimizer.state}
    assert actor < before, "the optimiser holds the actor's own parameters"
    hook.evaluator = ScriptedEvaluator(CHILD_WINS)
    assert hook.evaluate().switched
    after = {id(p) for p in optimizer.state}
    assert after == (before if choice == "keep" else before - actor)
    take_a_step(training.agent.loss, optimizer)
    training.close()


@pytest.mark.parametrize("choice", ["keep", "reset"])
def test_the_critic_is_kept_or_begun_anew(choice, actor):
    critic = ValueOperator(MLP(in_features=3, out_features=1, num_cells=[4]))
    before = {name: p.clone() for name, p in critic.named_parameters()}
    objects = [id(p) for p in critic.parameters()]
    hook = hook_of(
        actor, ScriptedEvaluator(CHILD_WINS), critic=critic, critic_on_switch=choice
    )
    hook.evaluate()
    kept = all((p == before[name]).all() for name, p in critic.named_parameters())
    assert kept == (choice == "keep")
    assert [id(p) for p in critic.parameters()] == objects


@pytest.mark.parametrize("choice", ["keep", "reset"])
def test_a_trunk_that_actor_and_critic_share_is_the_winners(choice):
    trunk = TensorDictModule(MLP(3, 8, num_cells=[8]), ["observation"], ["hidden"])
    policy = TensorDictModule(nn.Linear(8, 2), ["hidden"], ["action"])
    value = ValueOperator(MLP(8, 1, num_cells=[4]), in_keys=["hidden"])
    model = ActorValueOperator(trunk, policy, value)
    actor, critic = model.get_policy_operator(), model.get_value_operator()
    before = {name: p.clone() for name, p in value.named_parameters()}
    evaluator = ScriptedEvaluator(CHILD_WINS)
    hook = hook_of(actor, evaluator, critic=critic, critic_on_switch=choice)
    assert hook.evaluate().switched
    winner, now = evaluator.populations[0][2], genome_of(actor)
    assert (now == winner).all()
    kept = all((p == before[name]).all() for name, p in value.named_parameters())
    assert kept == (choice == "keep")


def test_a_critic_that_has_no_layer_of_its_own_cannot_be_reset(actor):
    with pytest.raises(ValueError, match="no layers to reset that are not the actor's"):
        hook_of(actor, ScriptedEvaluator(), critic=actor, critic_on_switch="reset")


def test_evaluations_in_which_no_fitness_is_a_number_are_counted(actor):
    nan = float("nan")
    evaluator = ScriptedEvaluator([nan, nan, nan], [nan, 1.0, nan], [nan, nan, nan])
    hook = hook_of(actor, evaluator)
    before = genome_of(actor)
    assert not hook.evaluate().switched
    assert (genome_of(actor) == before).all()
    assert hook.counts.without_fitness == 1
    assert hook.evaluate().switched
    hook.evaluate()
    assert hook.counts.without_fitness == 2
    other = hook_of(actor, ScriptedEvaluator(CHILD_WINS))
    other.load_state_dict(hook.state_dict())
    assert other.counts.without_fitness == 2


def test_the_collector_acts_with_the_new_weights(tiny):
    seed_everything(0)
    training = build_training(tiny())
    training.evolution.evaluator = ScriptedEvaluator(CHILD_WINS)
    batches = iter(training.agent.collector)
    next(batches)
    before = genome_of(training.agent.actor)
    assert training.evolution.evaluate().switched
    batch = next(batches)
    observation = batch["observation"]
    new = training.agent.actor.get_dist_params(
        TensorDict(observation=observation, batch_size=observation.shape[:-1])
    )["loc"]
    assert torch.allclose(batch["loc"], new, atol=1e-6)
    assert not (genome_of(training.agent.actor) == before).all()
    training.close()


# Accounting and state


def test_population_steps_are_counted(actor):
    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS, frames=7))
    assert hook.evaluate().population_steps == 21
    hook.evaluate()
    assert hook.counts.steps == 42


def test_callbacks_hear_of_every_evaluation(actor):
    heard = []
    hook = hook_of(actor, ScriptedEvaluator(PARENT_WINS), on_evaluation=[heard.append])
    results = [hook.evaluate(), hook.evaluate()]
    assert heard == results
    assert [result.number for result in heard] == [0, 1]


def test_a_restored_hook_goes_on_identically(actor_of):
    script = (PARENT_WINS, CHILD_WINS, PARENT_WINS)
    batches = [batch_of("0+22", "111"), batch_of("2-44", "1+33"), batch_of("44", "3+5")]

    def start():
        torch.manual_seed(3)
        actor = actor_of("tanh_normal")
        return hook_of(
            actor, ScriptedEvaluator(*script), period_episodes=1, window_episodes=2
        )

    def go_on(hook, batches):
        for batch in batches:
            hook.watch.observe(batch)
            hook()

    whole = start()
    go_on(whole, batches)
    assert whole.counts.evaluations == 3
    for cut in (0, 1, 2):
        first, second = start(), start()
        go_on(first, batches[:cut])
        second.load_state_dict(first.state_dict())
        second.actor.load_state_dict(first.actor.state_dict())
        go_on(second, batches[cut:])
        expected = whole.evaluator.populations[cut:]
        for mine, other in zip(second.evaluator.populations, expected, strict=True):
            assert (mine == other).all()
        state, other = second.state_dict(), whole.state_dict()
        assert (state.pop("generator") == other.pop("generator")).all()
        assert state == other


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_children": 0}, "num_children=0"),
        ({"period_episodes": 0}, "period_episodes=0"),
        ({"optimizer_on_switch": "reset"}, "optimizer_on_switch='reset'"),
        ({"critic_on_switch": "reset"}, "critic_on_switch='reset'"),
        ({"window_episodes": 0}, "window_episodes=0"),
    ],
)
def test_bad_options_are_named(options, message, actor):
    with pytest.raises(ValueError, match=message):
        hook_of(actor, ScriptedEvaluator(PARENT_WINS), **options)


# TorchRL's own trainer


def test_it_registers_on_torchrls_own_ppo_trainer():
    torch.manual_seed(0)
    env = GymEnv("CartPole-v1")
    network = MLP(in_features=4, out_features=2, num_cells=[8])
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(in_features=4, out_features=1, num_cells=[8]))
    loss = ClipPPOLoss(actor, critic)
    evaluator = PopulationEvaluator(
        actor,
        num_episodes=2,
        create_env_fn=lambda: GymEnv("CartPole-v1"),
        max_steps=25,
        fitness="return",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = PPOTrainer(
            collector=Collector(env, actor, frames_per_batch=100, total_frames=300),
            total_frames=300,
            frame_skip=1,
            optim_steps_per_batch=None,
            loss_module=loss,
            optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
            num_epochs=1,
            replay_buffer=TensorDictReplayBuffer(
                storage=LazyTensorStorage(100),
                sampler=SamplerWithoutReplacement(),
                batch_size=50,
            ),
            gae=GAE(gamma=0.99, lmbda=0.95, value_network=critic),
            enable_logging=False,
            progress_bar=False,
        )
    heard = []
    hook = GeneticHook(
        actor,
        evaluator,
        MutatedChildren(2),
        FullContest("child"),
        period_episodes=2,
        watch=EpisodeWatch(3),
        on_evaluation=[heard.append],
    )
    hook.register(trainer)
    assert any("genetic_hook" in str(key) for key in _keys(trainer.state_dict()))
    trainer.train()
    assert hook.watch.episodes_completed >= 6
    assert 2 <= len(heard) <= 3, "at most one evaluation a batch"
    assert hook.counts.steps == sum(e.population_steps for e in heard) > 0
    assert all((e.scores["steps"] <= 25).all() for e in heard)
    assert hook.counts.switches == sum(e.switched for e in heard)
    evaluator.close()


def _keys(state):
    for key, value in state.items():
        yield key
        if isinstance(value, dict):
            yield from _keys(value)
