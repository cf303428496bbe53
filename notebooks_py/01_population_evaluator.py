# %% [markdown]
# # Score a population of policies
#
# `PopulationEvaluator` rolls out all members of a population as one batch: every member
# plays the same episodes, and the result says how well each one did. Here one untrained
# policy and its mutated children steer a vessel through waves.

# %%
import os

import torch

from gdrl_tasks import make_task
from gdrl_torchrl import (
    NavigationEnv,
    PopulationEvaluator,
    bernoulli_mutation,
    concatenate,
    genome_of,
    install,
    make_tanh_normal_actor,
    select_best,
    stack_copies,
)

smoke = os.environ.get("GDRL_SMOKE") == "1"
children, episodes = (2, 2) if smoke else (10, 10)
torch.manual_seed(0)

# %% The worlds: one for every member and episode.
task = make_task("water", sea="lake", step_limit=10 if smoke else 160)
env = NavigationEnv(task, num_worlds=(1 + children) * episodes, seed=0)
print(f"{env.batch_size[0]} worlds, observation {list(task.spec.observation)}")

# %% A policy, and a population of it: a copy, then children with mutated weights.
actor = make_tanh_normal_actor(
    task.spec.observation_size, env.full_action_spec_unbatched["action"]
)
genome = genome_of(actor)
copies, draws = stack_copies(genome, children), torch.Generator().manual_seed(0)
mutants = bernoulli_mutation(copies, mut_p=0.75, std=0.5, generator=draws)
population = concatenate([stack_copies(genome, 1), mutants])

# %% Evaluate: `fitness` counts the episodes in which the goal was reached.
evaluator = PopulationEvaluator(actor, num_episodes=episodes, create_env_fn=lambda: env)
scores = evaluator.evaluate(population)
for member, (goals, mean) in enumerate(
    zip(scores["fitness"].tolist(), scores["return_mean"].tolist(), strict=True)
):
    print(f"member {member}: {goals:.0f} of {episodes} goals, mean return {mean:+.2f}")
print(f"{int(scores['frames'].sum())} environment steps")

# %% The best one becomes the policy: same Parameter objects, new values.
best = select_best(scores)
install(actor, population[best])
print(f"member {best} is the policy now")
evaluator.close()
