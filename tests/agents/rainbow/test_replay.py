"""Prioritised replay: draws, weights, shared experience, and exact resumption."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from gdrl_torchrl.agents.rainbow.n_step import NStep
from gdrl_torchrl.agents.rainbow.replay import (
    draw_minibatch,
    make_prioritized_buffer,
    note_errors,
)
from gdrl_torchrl.agents.rainbow.replay_state import buffer_state, load_buffer_state
from gdrl_torchrl.agents.rainbow.shared_experience import random_share, share_experience

CAPACITY = 20


def make(**options):
    options = {"alpha": 0.5, "beta": 0.4, "batch_size": 8, "seed": 0} | options
    return make_prioritized_buffer(options.pop("capacity", CAPACITY), **options)


def make_rows(first, count):
    """Transitions ``[count]`` that know their number; every fifth ends an episode."""
    number = torch.arange(first, first + count)
    done = (number % 5 == 4)[:, None]
    return TensorDict(
        {
            "observation": number[:, None].float(),
            "action": number % 3,
            "next": {
                "observation": number[:, None].float() + 1.0,
                "reward": torch.ones(count, 1),
                "terminated": done,
                "done": done.clone(),
            },
        },
        batch_size=[count],
    )


def numbers_in(buffer):
    return sorted(int(n) for n in buffer.storage[:]["observation"][:, 0])


def give_priorities(buffer, priorities):
    priorities = torch.as_tensor(priorities)
    buffer.update_priority(torch.arange(len(priorities)), priorities)


def draws(buffer, count=100):
    return torch.stack([buffer.sample()["index"] for _ in range(count)])


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def test_draws_depend_on_the_seed_alone():
    def drawn(seed, disturb):
        if disturb:
            torch.manual_seed(99)
            np.random.seed(99)
        buffer = make(seed=seed)
        buffer.extend(make_rows(0, 15))
        give_priorities(buffer, torch.arange(1.0, 16.0))
        if disturb:
            torch.randn(7)
            np.random.rand(7)
        return draws(buffer)

    assert torch.equal(drawn(3, False), drawn(3, True))
    assert not torch.equal(drawn(3, False), drawn(4, False))


def test_drawing_leaves_the_global_generators_alone():
    buffer = make()
    buffer.extend(make_rows(0, 15))
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    draws(buffer, 5)
    share_experience(buffer, make_rows(0, 10), NStep(0.9, 3), 0.5, rng())
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert (np.random.get_state()[1] == numpy_state).all()


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_draws_are_as_frequent_as_the_powers_of_priorities(alpha):
    buffer = make(alpha=alpha, batch_size=50)
    buffer.extend(make_rows(0, 6))
    priorities = torch.tensor([0.1, 0.2, 0.5, 1.0, 2.0, 0.0])
    give_priorities(buffer, priorities)
    shares = torch.bincount(draws(buffer, 400).flatten(), minlength=6) / 20_000
    expected = (priorities + 1e-6) ** alpha
    expected = expected / expected.sum()
    # Four standard deviations.
    tolerance = 4.0 * (expected * (1.0 - expected) / 20_000).sqrt() + 1e-4
    assert ((shares - expected).abs() < tolerance).all()


@pytest.mark.parametrize("relative_to_batch", [True, False])
@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
def test_weights_follow_beta_exactly_and_at_once(relative_to_batch, beta):
    alpha, eps = 0.7, 1e-3
    buffer = make(alpha=alpha, eps=eps, weights_relative_to_batch=relative_to_batch)
    priorities = [0.02, 3.0, 0.5, 1.0, 0.25, 2.0, 0.7, 0.9, 1.2, 1.4]
    buffer.extend(make_rows(0, 10))
    give_priorities(buffer, priorities)
    buffer.sample()
    buffer.sampler.beta = beta
    chances = [(p + eps) ** alpha for p in priorities]
    chances = [c / sum(chances) for c in chances]
    seen = 0
    for _ in range(20):
        sample = buffer.sample()
        raw = [(10 * chances[i]) ** -beta for i in sample["index"].tolist()]
        largest = max(raw) if relative_to_batch else (10 * min(chances)) ** -beta
        expected = [w / largest for w in raw]
        assert sample["priority_weight"].tolist() == pytest.approx(expected, rel=1e-4)
        seen += 0 in sample["index"]
    assert 0 < seen < 20  # both with and without the smallest priority


def test_one_transition_without_error_does_not_shrink_the_weights_of_others():
    buffer = make(beta=1.0)
    buffer.extend(make_rows(0, 10))
    give_priorities(buffer, [0.0] + [1.0] * 9)
    for _ in range(20):
        sample = buffer.sample()
        if 0 not in sample["index"]:
            assert torch.equal(sample["priority_weight"], torch.ones(8))


def test_new_items_get_the_largest_priority_that_ever_was():
    buffer = make(alpha=1.0, batch_size=100)
    buffer.extend(make_rows(0, 10))
    give_priorities(buffer, torch.full((10,), 1e-3))
    give_priorities(buffer, [7.0])
    give_priorities(buffer, [1e-3])
    buffer.extend(make_rows(10, 2))
    assert set(draws(buffer, 5).flatten().tolist()) == {10, 11}


def test_priorities_are_read_from_what_a_loss_writes_into_a_sample():
    buffer = make(alpha=1.0, batch_size=40)
    buffer.extend(make_rows(0, 10))
    sample = buffer.sample()
    assert set(sample["index"].tolist()) == set(range(10))
    sample["td_error"] = torch.where(sample["index"] == 4, 5.0, 0.0)[:, None]
    buffer.update_tensordict_priority(sample)
    assert set(draws(buffer, 5).flatten().tolist()) == {4}


def test_a_minibatch_is_the_buffers_sample_and_its_errors_are_priorities():
    buffers = [make(), make()]
    for buffer in buffers:
        buffer.extend(make_rows(0, 50))
    plain, short = buffers
    for _ in range(5):
        expected, found = plain.sample(), draw_minibatch(short)
        assert set(found.keys(True, True)) == set(expected.keys(True, True))
        assert (found == expected).all()
        error = torch.rand(len(found), 1)
        plain.update_tensordict_priority(expected.set("td_error", error))
        note_errors(short, found.set("td_error", error))
        assert torch.equal(*(buffer_state(buffer)["priorities"] for buffer in buffers))


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.24, 2), (0.5, 5), (1.0, 10)])
def test_a_random_share_has_its_size_its_order_and_nothing_twice(share, count):
    chosen = random_share(make_rows(0, 10), share, rng())["observation"][:, 0].tolist()
    assert len(chosen) == count
    assert chosen == sorted(set(chosen))


def test_every_transition_has_the_same_chance_to_be_shared():
    generator, counts = rng(), torch.zeros(10)
    for _ in range(1000):
        chosen = random_share(make_rows(0, 10), 0.3, generator)
        counts[chosen["observation"][:, 0].long()] += 1
    assert (counts / 1000 - 0.3).abs().max() < 0.06
    one, same = (random_share(make_rows(0, 10), 0.3, rng(1)) for _ in range(2))
    assert (one == same).all()


def test_shared_windows_are_made_of_whole_episodes_before_some_are_chosen():
    buffer = make()
    transitions = make_rows(0, 15)
    before = transitions.clone()
    count = share_experience(buffer, transitions, NStep(0.9, 3), 0.4, rng())
    assert count == len(buffer) == 6
    items = buffer.storage[:]
    start, after = items["observation"][:, 0], items["next", "observation"][:, 0]
    steps = torch.minimum(5 - start % 5, torch.tensor(3.0))
    assert torch.equal(after, start + steps)
    assert torch.equal(items["steps_to_next_obs"][:, 0].float(), steps)
    assert torch.equal(items["next", "terminated"][:, 0], start % 5 >= 2)
    assert set(transitions.keys(True, True)) == set(before.keys(True, True))
    assert (transitions == before).all()


def test_populations_and_agents_fill_one_buffer():
    buffer, n_step = make(), NStep(0.9, 3)
    buffer.extend(n_step(make_rows(0, 10).reshape(2, 5)))
    assert share_experience(buffer, make_rows(100, 15), n_step, 0.4, rng()) == 6
    numbers = numbers_in(buffer)
    assert numbers[:10] == list(range(10))
    assert all(number >= 100 for number in numbers[10:])
    assert buffer.sample()["steps_to_next_obs"].shape == (8, 1)


def test_stale_priorities_are_dropped():
    buffer = make(alpha=1.0, batch_size=50)
    buffer.extend(make_rows(0, 10))
    give_priorities(buffer, torch.full((10,), 0.5))
    stale = make_rows(100, 5)
    stale["td_error"] = torch.full((5, 1), 1e-9)
    stale["index"] = torch.zeros(5, dtype=torch.long)
    stale["priority_weight"] = torch.full((5,), 0.3)
    share_experience(buffer, stale, lambda windows: windows, 1.0, rng())
    # The largest priority so far is 1, that of the first items.
    shares = torch.bincount(draws(buffer, 200).flatten(), minlength=15) / 10_000
    assert shares[:10].tolist() == pytest.approx([0.05] * 10, abs=0.01)
    assert shares[10:].tolist() == pytest.approx([0.1] * 5, abs=0.02)
    assert "td_error" not in buffer.storage[:].keys()  # noqa: SIM118


@pytest.mark.parametrize("share", [1.0, 0.8])
def test_of_more_transitions_than_fit_a_random_part_enters(share):
    buffer = make()
    buffer.extend(make_rows(500, 3))
    rows = make_rows(0, 100)
    assert share_experience(buffer, rows, lambda windows: windows, share, rng()) == CAPACITY
    numbers = numbers_in(buffer)
    assert len(numbers) == len(set(numbers)) == CAPACITY
    assert max(numbers) < 100
    assert numbers[-1] - numbers[0] > CAPACITY


def test_a_share_that_rounds_to_nothing_enters_nothing():
    buffer = make()
    assert share_experience(buffer, make_rows(0, 10), NStep(0.9, 3), 0.04, rng()) == 0
    assert len(buffer) == 0


class Saved:
    """A buffer as a component of a checkpoint."""

    def __init__(self, buffer):
        self.buffer = buffer

    def state_dict(self):
        return buffer_state(self.buffer)

    def load_state_dict(self, state):
        load_buffer_state(self.buffer, state)


def used(buffer, transitions, updates=7):
    """A buffer with a history: overwritten items, uneven priorities, used randomness."""
    generator = rng(5)
    for first in range(0, transitions, 6):
        buffer.extend(make_rows(first, min(6, transitions - first)))
    for _ in range(updates):
        sample = buffer.sample()
        sample["td_error"] = torch.rand(8, 1, generator=generator) ** 3 * 10.0
        buffer.update_tensordict_priority(sample)
    return buffer


def future(buffer):
    """The next 100 samples, with new items and priorities in between."""
    generator, samples = rng(6), []
    for step in range(100):
        sample = buffer.sample()
        sample["td_error"] = torch.rand(8, 1, generator=generator) * 3.0
        samples.append(sample.clone())
        if step % 3 == 0:
            buffer.update_tensordict_priority(sample)
        if step % 7 == 0:
            buffer.extend(make_rows(1000 + step, 4))
    return torch.stack(samples)


@pytest.mark.parametrize("transitions", [11, CAPACITY, 57])
def test_a_restored_buffer_draws_the_same_100_samples(tmp_path, transitions):
    def checkpoint(buffer):
        archive = StateDictCheckpointAdapter("archive")
        return Checkpoint().register("buffer", Saved(buffer), adapter=archive)

    buffer = used(make(seed=1), transitions)
    buffer.sampler.beta = 0.75
    checkpoint(buffer).save(tmp_path / "saved")
    expected = future(buffer)
    assert expected["index"].unique().numel() == CAPACITY
    # Into a fresh buffer, and into one that has a history of its own.
    for other in (make(seed=2), used(make(seed=3), 40, updates=30)):
        checkpoint(other).load(tmp_path / "saved")
        assert other.sampler.beta == 0.75
        assert len(other) == min(transitions, CAPACITY)
        assert other.write_count == transitions
        restored = future(other)
        assert (restored == expected).all()


def test_an_empty_buffer_is_restored_too():
    buffer = make(seed=1)
    state = buffer_state(buffer)
    other = used(make(seed=2), 30)
    load_buffer_state(other, state)
    assert len(other) == 0
    for one in (buffer, other):
        one.extend(make_rows(0, 15))
    assert (future(buffer) == future(other)).all()


def test_a_state_is_a_copy():
    buffer = used(make(seed=1), 15)
    state = buffer_state(buffer)
    other = make(seed=2)
    load_buffer_state(other, state)
    expected = future(other)
    future(buffer)
    load_buffer_state(buffer, state)
    assert (future(buffer) == expected).all()


def test_a_state_of_another_kind_of_buffer_is_refused():
    state = buffer_state(used(make(), 15))
    for options in ({"capacity": 30}, {"alpha": 0.6}):
        with pytest.raises(ValueError, match=next(iter(options))):
            load_buffer_state(make(**options), state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"capacity": 0}, "capacity"),
        ({"batch_size": 0}, "batch_size"),
        ({"eps": 0.0}, "eps"),
        ({"alpha": -1.0}, "alpha"),
        ({"beta": -1.0}, "beta"),
    ],
)
def test_unusable_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_share_outside_0_and_1_is_refused(share):
    with pytest.raises(ValueError, match="share"):
        random_share(make_rows(0, 10), share, rng())
