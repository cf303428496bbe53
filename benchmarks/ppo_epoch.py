"""Time of PPO's optimisation of one collected batch, and of the same one by hand.

    python -m benchmarks.ppo_epoch

What a training iteration does after collection, with the defaults of the water task:
advantages and epochs of shuffled minibatches, in the loop of a run; against
``plain_ppo``, which takes turns with it. Before that both learn from one minibatch, and
must agree. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import logging
import os
import statistics
from collections.abc import Iterator
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import torch
from tensordict import TensorDictBase

from benchmarks.common import finish, measure, ratio, show
from benchmarks.plain_ppo import PPO, Collected, Networks, before_tanh
from gdrl_tasks import make_task
from gdrl_torchrl.agents.base import Agent
from gdrl_torchrl.agents.collectors.finite_batches import check_batch
from gdrl_torchrl.agents.loop import TrainingLoop
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.runs.build import make_agent as make_agent_of

TOLERANCE = 1e-5
"""Largest difference, relative to the largest entry, that counts as rounding."""
PLACES = {
    "actor.module.0.module.0": "actor.layers",
    "critic.module": "critic.layers",
}
"""Our networks and those by hand; TorchRL counts activations as layers."""


def make_agent() -> Agent:
    """The agent of a run with the defaults."""
    torch.manual_seed(0)
    config = ExperimentConfig(
        task=task_config_class("water")(), algorithm=PPOConfig(), network=NetworkConfig()
    )
    return make_agent_of(make_task("water"), config)


def collect(agent: Agent) -> TensorDictBase:
    """A batch ``[W, T]`` of the task, with episodes that end at random in both ways."""
    assert agent.collector is not None
    batch = next(iter(agent.collector)).clone()
    following: Any = batch["next"]
    for name in ("terminated", "truncated"):
        following[name] = torch.rand(following[name].shape) < 0.01
    following["done"] = following["terminated"] | following["truncated"]
    return batch


class Repeated:
    """A collector that gives the same batch, without what learning added to it."""

    def __init__(self, batch: TensorDictBase) -> None:
        self._batch = batch

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Copies, without end."""
        while True:
            yield self._batch.copy()


def by_hand(batch: TensorDictBase) -> Collected:
    """The batch as tensors."""
    following: Any = batch["next"]
    views = [
        torch.cat([rows["observation"], rows["time_left"]], dim=-1)
        for rows in (batch, following)
    ]
    return Collected(
        observation=batch["observation"],
        seen=torch.stack(views),
        action=batch["action"],
        log_prob=batch["action_log_prob"],
        reward=following["reward"].squeeze(-1),
        done=following["done"].squeeze(-1),
        terminated=following["terminated"].squeeze(-1),
    )


def make_reference(agent: Agent) -> PPO:
    """The optimisation by hand, with the weights and settings of ours."""
    spec, config, network = make_task("water").spec, PPOConfig(), NetworkConfig()
    networks = Networks(
        spec.observation_size,
        spec.action_size,
        network.actor_cells,
        network.critic_cells,
    )
    networks.load_state_dict(weights_of(agent))
    return PPO(
        networks,
        num_epochs=config.num_epochs,
        minibatch_size=config.minibatch_size,
        learning_rate=config.learning_rate,
        gamma=config.gamma,
        lmbda=config.lmbda,
        clip_epsilon=config.clip_epsilon,
        critic_coeff=config.critic_coeff,
        max_grad_norm=config.max_grad_norm,
    )


def weights_of(agent: Agent) -> dict[str, torch.Tensor]:
    """Our weights by the names of those by hand."""
    assert agent.critic is not None
    found = {}
    for network, module in (("actor", agent.actor), ("critic", agent.critic)):
        for name, weight in module.named_parameters():
            place, number, attribute = f"{network}.{name}".rsplit(".", 2)
            name = f"{PLACES.get(place)}.{int(number) // 2}.{attribute}"
            if attribute == "state_independent_scale":
                name = "log_scale"
            found[name] = weight.detach()
    return found


def compare(what: str, own: torch.Tensor, its: torch.Tensor) -> None:
    """Raise RuntimeError unless two tensors agree."""
    error = float((own - its).abs().max() / its.abs().max())
    if not error <= TOLERANCE:
        raise RuntimeError(f"{what} differs by hand: by {error:.1e}")


def check_equal() -> None:
    """One minibatch of both, of agents of their own.

    Raises:
        RuntimeError: If advantages, losses, gradients or weights differ.
    """
    agent = make_agent()
    learner: Any = agent.learner
    batch = collect(agent)
    # Weights that have moved since, so that some ratios are clipped.
    for weight in weights_of(agent).values():
        weight.add_(torch.randn_like(weight), alpha=0.1)
    reference = make_reference(agent)

    minibatch = learner.minibatches(batch)[0]
    losses = learner.update(minibatch)
    advantage, target = reference.estimate(by_hand(batch))
    compare("an advantage", batch["advantage"].squeeze(-1), advantage)
    compare("a target", batch["value_target"].squeeze(-1), target)
    observation = minibatch["observation"]
    *found, norm = reference.step(
        observation,
        torch.cat([observation, minibatch["time_left"]], dim=-1),
        *before_tanh(minibatch["action"], minibatch["action_log_prob"]),
        minibatch["advantage"].squeeze(-1),
        minibatch["value_target"].squeeze(-1),
    )
    own = torch.stack([losses["loss_objective"], losses["loss_critic"]])
    compare("a loss", own.detach(), torch.stack(found))
    own = next(value for name, value in losses.items() if name.startswith("grad_norm"))
    compare("the norm of the gradient", own, norm)
    its = reference.networks.state_dict()
    for name, weight in weights_of(agent).items():
        compare(f"the new {name}", weight, its[name])
    agent.collector.shutdown()


def main() -> None:
    """Check, measure and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    check_equal()
    agent = make_agent()
    collected = collect(agent)
    repeated: Any = Repeated(collected)
    loop = TrainingLoop(agent.learner, repeated)
    loop.register_op("batch_process", check_batch)
    loop.register_op("post_steps", loop.request_stop)
    reference, inputs = make_reference(agent), by_hand(collected)

    def ours() -> int:
        loop.train()
        return 1

    def its() -> int:
        reference.learn(inputs)
        return 1

    rates = measure(ours, its, repeats=options.repeats)
    agent.collector.shutdown()
    own_ms, its_ms = (1000.0 / statistics.median(found) for found in rates)
    result = {
        "ms_per_iteration": round(own_ms, 2),
        "by_hand_ms_per_iteration": round(its_ms, 2),
        "time_over_by_hand": ratio(rates[1], rates[0]),
    }
    print("PPO's optimisation of a batch: milliseconds")
    show("loop of a run", own_ms, 1)
    show("by hand", its_ms, 1)
    show("time over the hand-written", result["time_over_by_hand"], 2)
    finish(result)


if __name__ == "__main__":
    main()
