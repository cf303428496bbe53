"""Every tensordict key of the project, once."""

from __future__ import annotations

OBSERVATION = "observation"
ACTION = "action"
REWARD = "reward"
DONE = "done"
TERMINATED = "terminated"
TRUNCATED = "truncated"
STEP_MASK = "_step"
RESET_MASK = "_reset"

# Of navigation environments, at every step.
SUCCESS = "success"
OUTCOME = "outcome"
EPISODE_NUMBER = "episode_number"
EPISODE_SEED = "episode_seed"
TIME_LEFT = "time_left"
EPISODE_STEPS = "episode_steps"
EPISODE_RETURN = "episode_return"
PATH_LENGTH = "path_length"
SHORTEST_PATH = "shortest_path"

# Of population evaluation.
PARAMS = "params"
FITNESS = "fitness"
SUCCESS_RATE = "success_rate"
RETURN_MEAN = "return_mean"
SUCCESSES = "successes"
RETURNS = "returns"
STEPS = "steps"
FRAMES = "frames"
OUTCOMES = "outcomes"
