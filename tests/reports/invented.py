"""Invented results, as studies and runs write them."""

from __future__ import annotations

import json

import numpy as np

from gdrl_torchrl.studies.results import StudyResults

TASKS = {"near": ["task=water"], "paper": ["task=indoor"]}
METHODS = {
    "ppo": (["near"], 0.75),
    "gppo": (["near"], 0.85),
    "rainbow": (["paper"], 0.7),
    "grainbow": (["paper"], 0.9),
}
POINTS = 20
STEPS = {"near": 200_000, "paper": 300_000}


def protocol(seeds, hypotheses=None, baseline=None):
    return {
        "name": "invented",
        "question": "Does <evolution> help & how much?",
        "tasks": TASKS,
        "methods": {
            name: {"tasks": tasks, "overrides": [f"experiment={name}"]}
            for name, (tasks, _) in METHODS.items()
        },
        "total_steps": STEPS,
        "seeds": list(seeds),
        "num_policies": POINTS,
        "episodes": 500,
        "evaluation_seed": 0,
        "metric": "area",
        "alpha": 0.05,
        "hypotheses": [
            hypothesis("water", "near", "gppo", "ppo"),
            hypothesis("indoor", "paper", "grainbow", "rainbow"),
        ]
        if hypotheses is None
        else hypotheses,
        **({"baseline": baseline} if baseline else {}),
    }


def hypothesis(name, task, method, against, alternative="greater", least=0.05):
    return {
        "name": name,
        "task": task,
        "method": method,
        "against": against,
        "alternative": alternative,
        "least_difference": least,
    }


def results_of(digest, task, method, seed, rng):
    """A run's row and its curve: success that rises to about the method's level."""
    level = np.clip(METHODS[method][1] + 0.06 * rng.standard_normal(), 0.0, 1.0)
    speed = rng.uniform(4.0, 8.0)
    marks = np.arange(1, POINTS + 1) / POINTS
    success = level * (1.0 - np.exp(-speed * marks)) + 0.02 * rng.standard_normal(POINTS)
    success = np.round(np.clip(success, 0.0, 1.0) * 500) / 500
    steps = (STEPS[task] * marks).astype(int)
    population = 0.4 if method.startswith("g") else 0.0
    agent = (steps * (1.0 - population)).astype(int)
    job = {"protocol": digest[:12], "task": task, "method": method, "seed": seed}
    curve = [
        job
        | {
            "point": k + 1,
            "total_steps": int(steps[k]),
            "agent_steps": int(agent[k]),
            "agent_episodes": int(agent[k] // 90),
            "wall_s": round(float(steps[k]) / 2000.0 + seed, 2),
            "success_rate": float(success[k]),
            "success_rate_sampled": float(0.95 * success[k]),
        }
        for k in range(POINTS)
    ]
    last = curve[-1]
    run = job | {
        "state": "done",
        "area": float(success.mean()),
        "area_sampled": float(0.95 * success.mean()),
        "success_rate": last["success_rate"],
        "success_rate_sampled": last["success_rate_sampled"],
        "return_mean": 4.6,
        "episode_steps": 93.0,
        "episode_s": 24.5,
        "speed_m_s": 0.225,
        "agent_steps": last["agent_steps"],
        "population_steps": last["total_steps"] - last["agent_steps"],
        "total_steps": last["total_steps"],
        "agent_episodes": last["agent_episodes"],
        "wall_s": last["wall_s"],
        "evaluations": 12 if population else 0,
        "switches": 7 if population else 0,
        "configuration": hash_of(method),
        "code": "0123abc",
        "packages": "torch 2.14.1",
        "error": "",
    }
    return run, curve


def elsewhere_of(run):
    """A run's row for rough water, where it succeeds a quarter less often."""
    job = {name: run[name] for name in ("protocol", "task", "method", "seed")}
    rates = {"success_rate": 0.75 * run["success_rate"], "success_rate_sampled": 0.5}
    return {**job, "worlds": "rough", **rates, "collision_rate": 0.0, "timeout_rate": 0.2}


def failure_of(run):
    """The row of a run that failed."""
    successes = ("area", "area_sampled", "success_rate", "success_rate_sampled")
    unknown = ("return_mean", "episode_steps", "episode_s", "speed_m_s")
    costs = ("agent_steps", "population_steps", "agent_episodes", "evaluations", "switches")
    return (
        run
        | dict.fromkeys(successes, 0.0)
        | dict.fromkeys(unknown, float("nan"))
        | dict.fromkeys(costs, 0)
        | {"wall_s": 0.0, "state": "failed", "error": "it diverged"}
    )


def hash_of(method):
    return {"ppo": "aaaa0001", "gppo": "aaaa0002"}.get(method, "bbbb0001")


def write_study(
    results, seeds=range(8), leave_out=(), failed=(), hypotheses=None, baseline=None
):
    """A study in a folder of results; the folder of the study."""
    given = protocol(seeds, hypotheses, baseline)
    study = StudyResults(results / "invented")
    study.begin(given)
    digest = study.protocol()[1]
    rng = np.random.default_rng(7)
    for seed in seeds:
        for method, (tasks, _) in METHODS.items():
            for task in tasks:
                run, curve = results_of(digest, task, method, seed, rng)
                if (method, seed) in leave_out:
                    continue
                if (method, seed) in failed:
                    run, curve = failure_of(run), []
                study.add(run, curve, [elsewhere_of(run)] if task == "near" else [])
    return results / "invented"


def write_run(folder, task, algorithm, seed, success, *, state="done", name="trial"):
    """A run directory as gdrl-train leaves it; its folder."""
    evolution = algorithm.startswith("g")
    config = {
        "name": name,
        "task": {"name": task},
        "algorithm": {"name": algorithm.removeprefix("g")},
        "evolution": {"name": "genetic", "enabled": evolution},
        "seed": seed,
    }
    run = folder / name / f"{algorithm:0<8}" / f"seed_{seed}"
    run.mkdir(parents=True)
    write_json(run / "config.json", config)
    write_json(run / "provenance.json", {"code": "0123abc", "packages": {}})
    if state == "done":
        costs = {"agent_steps": 1000, "population_steps": 500, "total_steps": 1500}
        write_json(run / "DONE", {"code": "0123abc"})
        write_json(
            run / "evaluation.json",
            {"task": task, "algorithm": algorithm, "seed": seed, "episodes": 100}
            | {"success_rate": success, "success_rate_sampled": success, "steps_mean": 90.0}
            | {"return_mean": 4.0, "wall_s": 3.0, **costs},
        )
    if state == "failed":
        write_json(run / "FAILED", {"error": "it diverged"})
    rows = ["agent_steps,total_steps,wall_s,episodes,success_rate,evaluations,switches"]
    rows += [
        f"{100 * k},{150 * k},{0.3 * k:.1f},{k},{success * k / 10},{k // 3},{k // 6}"
        for k in range(1, 11)
    ]
    (run / "metrics.csv").write_text("\n".join(rows) + "\n")
    return run


def write_json(path, content):
    path.write_text(json.dumps(content))
