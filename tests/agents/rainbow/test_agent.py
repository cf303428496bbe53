"""The Rainbow agent of a run: what it stores, how it learns, what a switch does."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl import keys
from gdrl_torchrl.agents.rainbow.replay import draw_minibatch
from gdrl_torchrl.agents.rainbow.replay_state import buffer_state
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import seed_everything


@pytest.fixture
def training_of(tiny_rainbow):
    """Builds trainings and closes them."""
    made = []

    def build(*overrides):
        seed_everything(0)
        made.append(build_training(tiny_rainbow(*overrides)))
        return made[-1]

    yield build
    for training in made:
        training.close()


def collected(training, batches):
    """Collect and store; the batches."""
    iterator = iter(training.agent.collector)
    learner = training.agent.learner
    found = [next(iterator) for _ in range(batches)]
    for batch in found:
        learner.store(batch)
    return found


def update(training):
    learner = training.agent.learner
    batch = draw_minibatch(learner.buffer)
    learner.step(batch, diagnose=True)
    return batch, learner.update.means.take()


def test_every_collected_step_is_stored_once(training_of):
    training = training_of("algorithm.replay_capacity=1000")
    batches = collected(training, 3)
    learner = training.agent.learner
    stored = learner.buffer[:]
    assert len(stored) == 3 * 40
    seen = torch.cat([batch["observation"].reshape(-1, 7) for batch in batches])
    assert (stored["observation"] == seen).all()
    assert stored["steps_to_next_obs"].max() == 3
    terminated = torch.cat([batch["next", "terminated"].reshape(-1) for batch in batches])
    assert stored["next", "terminated"].sum() > terminated.sum(), "flags are gathered"


def test_epsilon_decays_with_completed_episodes(training_of):
    training = training_of("algorithm.epsilon_decay=0.9", "algorithm.epsilon_end=0.3")
    learner = training.agent.learner
    assert float(learner.exploration.eps) == 1.0
    batches = collected(training, 1)
    ended = int(batches[0]["next", "done"].sum())
    assert 0 < ended < 11
    assert float(learner.exploration.eps) == pytest.approx(0.9**ended)
    collected(training, 6)
    assert float(learner.exploration.eps) == pytest.approx(0.3)


def test_collected_actions_explore_and_greedy_ones_do_not(training_of):
    training = training_of(
        "algorithm.frames_per_batch=400", "algorithm.collect_ahead=false"
    )
    batch = collected(training, 1)[0]
    assert len(batch["action"].unique()) == 5
    greedy = training.agent.actor(batch.select("observation").clone())["action"]
    assert (greedy != batch["action"]).float().mean() > 0.5
    training.agent.learner.exploration.eps.fill_(0.0)
    batch = next(iter(training.agent.collector))
    greedy = training.agent.actor(batch.select("observation").clone())["action"]
    assert (greedy == batch["action"]).all()


def test_nothing_is_learnt_while_the_buffer_warms_up(training_of):
    training = training_of("algorithm.warmup_steps=70")
    before = genome_of(training.agent.actor)
    learner = training.agent.learner
    learner.learn(next(iter(training.agent.collector)))
    assert len(learner.buffer) == 40
    assert learner.num_updates == 0
    assert (genome_of(training.agent.actor) == before).all()


def test_an_update_moves_agent_target_priorities_and_beta(training_of):
    training = training_of(
        "algorithm.target_tau=0.25", "algorithm.replay_beta_increment=0.1"
    )
    collected(training, 2)
    learner, loss = training.agent.learner, training.agent.loss
    online = loss.value_network_params.data.clone()
    target = loss.target_value_network_params.data.clone()
    batch, losses = update(training)
    assert math.isfinite(losses["loss"])
    moved = 0
    for key in online.keys(True, True):
        if key[-1] not in ("weight", "bias"):
            continue
        now = loss.value_network_params.data.get(key)
        moved += int((now != online.get(key)).any())
        expected = target.get(key) + 0.25 * (now - target.get(key))
        assert torch.allclose(loss.target_value_network_params.get(key), expected)
    assert moved > 4
    assert learner.buffer.sampler.beta == pytest.approx(0.5)
    tree = buffer_state(learner.buffer)["priorities"][batch["index"]]
    alpha = learner.buffer.sampler.alpha
    last = {
        int(i): float(e) for i, e in zip(batch["index"], batch["td_error"], strict=True)
    }
    for index, leaf in zip(batch["index"].tolist(), tree.reshape(-1).tolist(), strict=True):
        assert leaf == pytest.approx((last[index] + 1e-6) ** alpha, rel=1e-4)
    for _ in range(9):
        update(training)
    assert learner.buffer.sampler.beta == 1.0


def test_no_target_of_a_whole_run_is_clipped(training_of):
    training = training_of("algorithm.replay_capacity=2000", "task.step_limit=60")
    clipped = []
    collected(training, 10)
    for _ in range(20):
        batch, _ = update(training)
        clipped.append(float(training.agent.loss(batch)["clipped_mass"]))
    assert clipped == [0.0] * 20
    low, high = training.task.spec.return_range(0.99)
    support = training.agent.actor.support
    assert (float(support[0]), float(support[-1])) == pytest.approx((low, high))


def test_noisy_networks_learn_their_noise_and_draw_it_anew(training_of):
    training = training_of("algorithm.exploration=noisy")
    learner = training.agent.learner
    assert learner.exploration is None
    collected(training, 2)

    def named(end):
        parameters = training.agent.actor.state_dict()
        return {n: v.clone() for n, v in parameters.items() if n.endswith(end)}

    scales, noise = named("weight_sigma"), named("weight_epsilon")
    assert scales
    update(training)
    assert all((named("weight_sigma")[name] != v).any() for name, v in scales.items())
    assert all((named("weight_epsilon")[name] != v).any() for name, v in noise.items())
    assert not any(
        "sigma" in str(key) for key in genome_of(training.agent.actor).keys(True, True)
    )


class ScriptedEvaluator:
    """Lets one member win and gives transitions of two short episodes."""

    num_evaluations = 0

    def __init__(self, winner):
        self.winner = winner

    def evaluate_with_transitions(self, population, *, seeds=None):
        fitness = torch.zeros(len(population))
        fitness[self.winner] = 1.0
        scores = TensorDict(
            {
                keys.FITNESS: fitness,
                keys.RETURN_MEAN: fitness.clone(),
                keys.SUCCESS_RATE: fitness.clone(),
                keys.FRAMES: torch.full((len(population),), 20),
            },
            batch_size=[len(population)],
        )
        rows = 60
        done = torch.zeros(rows, 1, dtype=torch.bool)
        done[19::20] = True
        observation = 1000.0 + torch.arange(rows).float()[:, None].expand(rows, 7)
        transitions = TensorDict(
            {
                "observation": observation,
                "action": torch.zeros(rows, dtype=torch.int64),
                "td_error": torch.full((rows, 1), 1e9),
                "next": {
                    "observation": observation + 1.0,
                    "reward": torch.ones(rows, 1),
                    "done": done,
                    "terminated": done.clone(),
                },
            },
            batch_size=[rows],
        )
        return scores, transitions

    def evaluate(self, population, *, seeds=None):
        return self.evaluate_with_transitions(population)[0]

    def close(self):
        pass


@pytest.mark.parametrize("updates_for_shared", [False, True])
def test_shared_experience_may_have_as_many_updates_as_the_agents_own(
    updates_for_shared, training_of
):
    training = training_of(
        "evolution.experience_share=1.0",
        f"evolution.updates_for_shared={updates_for_shared}",
    )
    learner, settings = training.agent.learner, training.agent.learner.config
    batches = iter(training.agent.collector)
    for _ in range(2):
        learner.learn(next(batches))
    made, held = learner.num_updates, len(learner.buffer)
    training.evolution.evaluator = ScriptedEvaluator(2)
    training.evolution.evaluate()
    shared = len(learner.buffer) - held
    assert shared > settings.frames_per_batch
    for _ in range(2):
        learner.learn(next(batches))
    per_step = settings.updates_per_batch / settings.frames_per_batch
    more = int(shared * per_step) if updates_for_shared else 0
    assert learner.num_updates - made == 2 * settings.updates_per_batch + more


@pytest.mark.parametrize("winner", [0, 2])
def test_a_switch_moves_the_target_and_shares_experience(winner, training_of):
    training = training_of("evolution.target_tau=0.1", "evolution.experience_share=0.1")
    collected(training, 1)
    learner, loss = training.agent.learner, training.agent.loss
    training.evolution.evaluator = ScriptedEvaluator(winner)
    target = loss.target_value_network_params.data.clone()
    online = loss.value_network_params.data.clone()
    evaluation = training.evolution.evaluate()
    assert evaluation.switched == (winner != 0)
    expected = target.clone()
    for key in target.keys(True, True):
        now = loss.value_network_params.data.get(key)
        if key[-1] in ("weight", "bias"):
            expected.get(key).lerp_(now, 0.1 if evaluation.switched else 0.0)
            if not evaluation.switched:
                assert (now == online.get(key)).all()
    for key in target.keys(True, True):
        got = loss.target_value_network_params.data.get(key)
        assert torch.allclose(got, expected.get(key), atol=1e-7)
    shared = learner.buffer[:]["observation"][:, 0] >= 1000.0
    assert int(shared.sum()) == (6 if evaluation.switched else 0)
    if evaluation.switched:
        rows = learner.buffer[:][shared]
        first = rows["observation"][:, 0] - 1000.0
        horizon = (20.0 - first % 20.0).clamp(max=3.0)
        assert (rows["steps_to_next_obs"][:, 0] == horizon).all(), "whole episodes first"
        leaves = buffer_state(learner.buffer)["priorities"][shared]
        assert leaves.max() < 10.0, "stale priorities are dropped"


def test_without_a_share_no_transitions_are_kept(training_of):
    training = training_of("evolution.experience_share=0")
    assert training.evolution.hand_over.share_experience is None


def test_a_restored_learner_goes_on_bit_by_bit(training_of):
    training = training_of()
    collected(training, 2)
    update(training)
    learner, loss = training.agent.learner, training.agent.loss
    state = copy.deepcopy(
        [learner.state_dict(), loss.state_dict(), training.agent.optimizer.state_dict()]
    )
    expected = [update(training)[1] for _ in range(5)]
    other = training_of()
    collected(other, 1)
    parts = [other.agent.learner, other.agent.loss, other.agent.optimizer]
    for part, value in zip(parts, state, strict=True):
        part.load_state_dict(value)
    for losses in expected:
        _, mine = update(other)
        assert mine["loss"] == losses["loss"]
        assert mine["grad_norm"] == losses["grad_norm"]
    assert other.agent.learner.num_episodes == learner.num_episodes
    assert float(other.agent.learner.exploration.eps) == pytest.approx(
        float(learner.exploration.eps)
    )
