"""Steps of small environments on the water."""

from __future__ import annotations

import torch

WAVES = {"sea": "lake", "step_limit": 12}
RECORD = {
    "success",
    "outcome",
    "episode_seed",
    "episode_return",
    "path_length",
    "shortest_path",
}


def random_steps(env, count, *, seed=0):
    """Steps with actions of a generator of its own, from where the environment is."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, *env.action_spec.shape)
    return (2 * torch.rand(shape, generator=generator) - 1).unbind(0)


def walk(env, start, actions):
    state, rows = start, []
    for action in actions:
        state = env.step(state.set("action", action))
        rows.append(state["next"].clone())
        state = state["next"].clone()
    return torch.stack(rows)
