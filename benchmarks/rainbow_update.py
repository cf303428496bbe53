"""Time of one Rainbow update, and of the same update written by hand.

    python -m benchmarks.rainbow_update

An update is drawing a prioritised minibatch, loss, gradient, optimiser, target network
and priorities: ``RainbowLearner.draw`` and ``step``, against ``plain_rainbow``, which
takes turns with it. Before that both learn once from one minibatch, and must agree. The
last row is what a TorchRL user composes: its loss, target updater and buffer with the
same network. Network, batch and transitions have the indoor task's shape. The last line
is a JSON object.
"""

from __future__ import annotations

import argparse
import functools
import logging
import os
import statistics
from collections.abc import Callable, Mapping
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
from torchrl.objectives import DistributionalDQNLoss, SoftUpdate

from benchmarks.common import finish, measure, ratio, show
from benchmarks.plain_rainbow import DuelingNetwork, Rainbow, Replay
from gdrl_tasks import make_task
from gdrl_torchrl.agents.rainbow.agent import make_rainbow_actor
from gdrl_torchrl.agents.rainbow.learner import RainbowLearner
from gdrl_torchrl.agents.rainbow.loss import resample_noise
from gdrl_torchrl.agents.rainbow.replay import draw_minibatch
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.runs.build import make_agent

WIDTH = 64
TRANSITIONS = 20_000
TOLERANCE = 1e-5
"""Largest difference, relative to the largest entry, that counts as rounding."""
PLACES = {
    "features.0": "features",
    "advantage.0": "hidden",
    "advantage.2": "advantage",
    "value.2": "value",
}
"""Our layers and those of the network by hand, which has the streams' first as one."""


def make_learner(exploration: str) -> tuple[ExperimentConfig, RainbowLearner]:
    """What a run's trainer calls, with the experiments' network and a paper's minibatch."""
    config = ExperimentConfig(
        task=task_config_class("indoor")(),
        algorithm=RainbowConfig(
            minibatch_size=64, exploration=exploration, collect_ahead=False
        ),
        network=NetworkConfig(actor_cells=[WIDTH, WIDTH], activation="relu"),
    )
    agent: Any = make_agent(make_task("indoor"), config)
    agent.collector.shutdown()
    return config, agent.learner


def make_transitions(num_steps: int) -> tuple[TensorDict, torch.Tensor]:
    """Random transitions ``[N]`` over several steps, and priorities ``[N]``."""
    spec, shape = make_task("indoor").spec, (TRANSITIONS, 1)
    terminated = torch.rand(shape) < 0.05
    transitions = TensorDict(
        observation=torch.randn(TRANSITIONS, spec.observation_size),
        action=torch.randint(spec.action_size, (TRANSITIONS,)),
        steps_to_next_obs=torch.randint(1, num_steps + 1, shape),
        next=TensorDict(
            observation=torch.randn(TRANSITIONS, spec.observation_size),
            reward=0.1 * torch.randn(shape),
            terminated=terminated,
            done=terminated | (torch.rand(shape) < 0.01),
            batch_size=[TRANSITIONS],
        ),
        batch_size=[TRANSITIONS],
    )
    return transitions, torch.rand(TRANSITIONS)


def make_reference(learner: RainbowLearner, transitions: TensorDict) -> Rainbow:
    """The update by hand, with transitions and settings of ours."""
    config, spec = learner.config, make_task("indoor").spec
    replay = Replay(config.replay_capacity, spec.observation_size, config.replay_alpha)
    discount = config.gamma ** transitions["steps_to_next_obs"]
    replay.extend(
        transitions["observation"],
        transitions["action"],
        transitions["next", "observation"],
        transitions["next", "reward"],
        discount * ~transitions["next", "terminated"],
    )
    sizes = (spec.observation_size, WIDTH, spec.action_size, config.num_atoms)
    return Rainbow(
        DuelingNetwork(*sizes, noisy=config.exploration == "noisy"),
        replay,
        learner.loss.value_network_params["support"],
        batch_size=config.minibatch_size,
        learning_rate=config.learning_rate,
        tau=config.target_tau,
        max_grad_norm=config.max_grad_norm,
        beta=config.replay_beta,
        beta_increment=config.replay_beta_increment,
    )


def in_its_layout(
    params: TensorDictBase, take: Callable[[torch.Tensor], Any] = torch.Tensor.detach
) -> dict[str, torch.Tensor]:
    """Parameters and noise of ours, or what ``take`` makes of each, by its names."""
    tree: Any = params["module", "0", "module"]
    leaves = {".".join(key): take(value) for key, value in tree.items(True, True)}
    found = {}
    for name, value in leaves.items():
        place, attribute = name.rsplit(".", 1)
        if value is None or place not in PLACES:
            continue
        if place == "advantage.0":
            value = torch.cat([value, leaves[f"value.0.{attribute}"]])
        attribute = attribute.replace("_mu", "").replace("sigma", "scale")
        found[f"{PLACES[place]}.{attribute.replace('epsilon', 'noise')}"] = value
    return found


def compare(
    what: str, own: Mapping[str, torch.Tensor], its: Mapping[str, torch.Tensor]
) -> None:
    """Raise RuntimeError unless the tensors of the same names agree."""
    for name, value in own.items():
        other = its[name].reshape(value.shape)
        error = float((value - other).abs().max() / other.abs().max().clamp_min(1e-12))
        if not error <= TOLERANCE:
            raise RuntimeError(f"{what} differs by hand: {name} by {error:.1e}")


def check_equal(learner: RainbowLearner, reference: Rainbow) -> None:
    """One update of both, from one minibatch.

    Raises:
        RuntimeError: If draws, loss, gradients, weights or priorities differ.
    """
    loss: Any = learner.loss
    buffer: Any = learner.buffer
    networks = (
        (loss.value_network_params, reference.network),
        (loss.target_value_network_params, reference.target),
    )
    shares = torch.rand(learner.config.minibatch_size, generator=buffer._rng.clone_state())
    batch = draw_minibatch(learner.buffer)
    rows, weight = reference.replay.find(shares.double().numpy(), reference.beta)
    if not torch.equal(rows, batch["index"].long()):
        raise RuntimeError("the rows drawn differ by hand")
    compare("a weight", {"batch": batch["priority_weight"]}, {"batch": weight})

    # A target that differs from its network, and no bias of 0.
    for params, _ in networks:
        for leaf in params["module", "0", "module"].values(True, True):
            leaf.data.add_(torch.randn_like(leaf), alpha=0.05)
    # The same noise twice: once to be copied, and once more in the step.
    state = torch.get_rng_state()
    resample_noise(loss)
    for params, network in networks:
        network.load_state_dict(in_its_layout(params))
    loss(batch.copy())["loss"].backward()
    own = in_its_layout(loss.value_network_params, lambda leaf: leaf.grad)
    reference.loss(rows, weight)[0].backward()
    its: Any = {name: leaf.grad for name, leaf in reference.network.named_parameters()}
    compare("a gradient", own, its)
    learner.optimizer.zero_grad()

    torch.set_rng_state(state)
    losses = learner.step(batch)
    its = dict(zip(("loss", "grad_norm"), reference.learn(rows, weight), strict=True))
    compare("a number", {name: losses[name] for name in its}, its)
    for params, network in networks:
        compare("a new weight", in_its_layout(params), network.state_dict())
    leaves = torch.from_numpy(reference.replay.tree).chunk(2)[1]
    own = {"tree": torch.as_tensor(buffer.sampler._sum_tree[rows])}
    compare("a new priority", own, {"tree": leaves[rows].float()})


def make_stock_update(
    config: ExperimentConfig, transitions: TensorDict
) -> Callable[[], object]:
    """The update as composed from TorchRL's own parts."""
    algorithm: RainbowConfig = config.algorithm
    actor = make_rainbow_actor(make_task("indoor"), config.network, algorithm)
    loss = DistributionalDQNLoss(actor, gamma=algorithm.gamma, delay_value=True)
    updater = SoftUpdate(loss, tau=algorithm.target_tau)
    parameters = list(loss.parameters())
    optimizer = torch.optim.Adam(
        parameters, lr=algorithm.learning_rate, eps=1e-4, fused=True
    )
    buffer = TensorDictPrioritizedReplayBuffer(
        alpha=algorithm.replay_alpha,
        beta=algorithm.replay_beta,
        storage=LazyTensorStorage(algorithm.replay_capacity),
        batch_size=algorithm.minibatch_size,
    )
    buffer.extend(transitions)

    def update() -> None:
        batch = buffer.sample()
        loss(batch)["loss"].backward()
        nn.utils.clip_grad_norm_(parameters, algorithm.max_grad_norm)
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
        buffer.update_tensordict_priority(batch)

    return update


def repeat(update: Callable[[], object], count: int) -> int:
    """Update so many times."""
    for _ in range(count):
        update()
    return count


def measure_exploration(exploration: str, options: argparse.Namespace) -> dict[str, Any]:
    """A check, and updates per second of ours, by hand and, without noise, of TorchRL."""
    torch.manual_seed(0)
    config, learner = make_learner(exploration)
    transitions, priorities = make_transitions(learner.config.num_steps)
    rows = torch.arange(TRANSITIONS)
    reference = make_reference(learner, transitions)
    reference.replay.write(rows, priorities)
    learner.buffer.extend(transitions.clone())
    learner.buffer.update_priority(rows, priorities)
    check_equal(learner, reference)

    updates: list[Callable[[], object]] = [
        lambda: learner.step(draw_minibatch(learner.buffer)),
        reference.update,
    ]
    if exploration != "noisy":
        updates.append(make_stock_update(config, transitions.clone()))
    runs = [functools.partial(repeat, update, options.updates) for update in updates]
    rates = measure(*runs, repeats=options.repeats)
    own, its, *stock = map(statistics.median, rates)
    result = {
        "updates_per_s": round(own, 1),
        "by_hand_updates_per_s": round(its, 1),
        "time_over_by_hand": ratio(rates[1], rates[0]),
    }
    print(f"{exploration}: updates per second")
    show("RainbowLearner", own)
    show("by hand", its)
    if stock:
        show("TorchRL's loss, updater and buffer", stock[0])
        result["torchrl_updates_per_s"] = round(stock[0], 1)
    show("time over the hand-written", result["time_over_by_hand"], 2)
    return result


def main() -> None:
    """Measure both kinds of exploration and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--updates", type=int, default=200)
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    finish(
        {kind: measure_exploration(kind, options) for kind in ("epsilon_greedy", "noisy")}
    )


if __name__ == "__main__":
    main()
