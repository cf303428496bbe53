"""The projection of returns on the atoms, and what lies outside of them."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import pytest
import torch

from gdrl_torchrl.agents.rainbow.loss import RainbowLoss, project
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from tests.agents.rainbow.losses import ACTIONS, SIZE, brute_force_projection, make_batch


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    atoms=st.integers(2, 60),
    low=st.floats(-50.0, 5.0),
    width=st.floats(0.5, 100.0),
    rewards=st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=4),
    discount=st.sampled_from([0.0, 0.3, 0.97, 1.0]),
    seed=st.integers(0, 1000),
)
def test_the_projection_equals_a_loop_and_keeps_mass_and_mean(
    atoms, low, width, rewards, discount, seed
):
    generator = torch.Generator().manual_seed(seed)
    support = torch.linspace(low, low + width, atoms, dtype=torch.float64)
    chances = torch.rand(len(rewards), atoms, generator=generator).double() ** 4
    chances /= chances.sum(dim=-1, keepdim=True)
    # In units of the width, so that some stay inside and some do not.
    reward = torch.tensor(rewards, dtype=torch.float64)[:, None] * width
    out, outside = project(chances, reward, torch.tensor([[discount]]).double(), support)
    assert torch.allclose(out.sum(dim=-1), torch.ones(len(rewards)).double())
    assert (out >= 0.0).all()
    for i, row in enumerate(chances.tolist()):
        expected, clipped = brute_force_projection(
            row, float(reward[i]), discount, support.tolist()
        )
        assert out[i].tolist() == pytest.approx(expected, abs=1e-6)
        assert float(outside[i]) == pytest.approx(clipped, abs=1e-6)
        if clipped == 0.0:
            mean = float(reward[i]) + discount * float((chances[i] * support).sum())
            tolerance = 1e-3 * width / (atoms - 1) + 1e-6  # of what counts as inside
            assert float((out[i] * support).sum()) == pytest.approx(mean, abs=tolerance)


@pytest.mark.parametrize(
    ("reward", "lands"), [(-5.0, 0), (0.0, 0), (1.0, 1), (3.0, 3), (4.0, 4), (9.0, 4)]
)
def test_a_value_on_an_atom_stays_there_and_one_beyond_the_ends_goes_to_them(reward, lands):
    support = torch.arange(5.0)
    chances = torch.full((1, 5), 0.2)
    out, outside = project(
        chances, torch.tensor([[reward]]), torch.zeros(1, 1), support
    )  # a terminal transition
    assert out[0].tolist() == pytest.approx([float(i == lands) for i in range(5)])
    assert float(outside) == pytest.approx(float(not 0.0 <= reward <= 4.0))


def test_nothing_is_clipped_by_bounds_that_no_reward_leads_out_of():
    # The lowest and highest rewards per step, and the values of getting them for ever.
    gamma, low, high = 0.99, -0.01, 0.02
    bounds = (low / (1 - gamma), high / (1 - gamma))
    actor = make_q_actor(SIZE, ACTIONS, value_range=bounds, num_cells=(8,))
    loss = RainbowLoss(actor, gamma=gamma)
    steps = torch.arange(1, 52)[:, None]
    batch = make_batch(51).set("steps_to_next_obs", steps)
    for per_step in (low, high):
        batch["next", "reward"] = per_step * (1 - gamma**steps) / (1 - gamma)
        assert float(loss(batch.clone())["clipped_mass"]) == 0.0
    batch["next", "reward"] = batch["next", "reward"] + 0.1
    assert float(loss(batch)["clipped_mass"]) > 0.0
