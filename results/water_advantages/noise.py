"""Write how large PPO's advantages are in each batch of a run, and how many goals it holds.

    python noise.py noise.csv experiment=ppo_water seed=204 ...

Arguments after the first are those of ``gdrl-train``.
"""

import csv
import sys

from tensordict import TensorDictBase

from gdrl_torchrl.agents.ppo.agent import PPOLearner
from gdrl_torchrl.cli.train import main

if __name__ == "__main__":
    file = open(sys.argv.pop(1), "w", newline="", buffering=1)  # noqa: SIM115
    table = csv.writer(file, lineterminator="\n")
    table.writerow(["goals", "episodes", "advantage_std"])
    learn = PPOLearner.learn

    def measured(learner: PPOLearner, batch: TensorDictBase) -> None:
        """Learn as always, after a look at the advantages of a copy."""
        found = learner.advantage(batch.clone())
        ends = found["next"]
        goals, episodes = (ends["reward"] > 0.5).sum(), ends["done"].sum()
        spread = found["advantage"].std()
        table.writerow([int(goals), int(episodes), f"{float(spread):.5f}"])
        learn(learner, batch)

    PPOLearner.learn = measured
    main()
