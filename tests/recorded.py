"""Run directories made up for the figures."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

# total_steps, agent_steps, wall_s, success_rate, mut_p, switched, winner
ROWS = [
    (100, 100, 6.0, "", "", "", ""),
    (200, 200, 12.0, 0.0, "", "", ""),
    (700, 300, 24.0, 0.25, 0.75, 1, 3),
    (800, 400, 30.0, 0.5, "", "", ""),
    (1300, 500, 42.0, 0.5, 0.4, 0, 0),
    (1400, 600, 48.0, 1.0, "", "", ""),
]
COLUMNS = (
    "total_steps",
    "agent_steps",
    "wall_s",
    "success_rate",
    "mut_p",
    "switched",
    "winner",
)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    with (tmp_path / "metrics.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(ROWS)
    evaluation = {
        "task": "water",
        "algorithm": "gppo",
        "seed": 0,
        "episodes": 200,
        "success_rate": 0.95,
        "total_steps": 1400,
        "agent_steps": 600,
        "wall_s": 48.0,
    }
    (tmp_path / "evaluation.json").write_text(json.dumps(evaluation))
    return tmp_path


@pytest.fixture
def trajectories() -> dict[str, np.ndarray]:
    """Three episodes: two that reach their goal, a longer one that does not."""
    steps = np.array([4, 2, 6])
    goal = np.array([[4.0, 0.0], [0.0, 2.0], [-5.0, 0.0]])
    position = np.full((7, 3, 2), np.nan)
    for k, end in enumerate((goal[0], goal[1], np.array([-1.0, -1.0]))):
        position[: steps[k] + 1, k] = np.linspace(0.0, 1.0, steps[k] + 1)[:, None] * end
    side = np.linspace(-7.0, 7.0, 50)
    return {
        "position": position,
        "heading": np.zeros((7, 3)),
        "action": np.zeros((6, 3, 2)),
        "goal": goal,
        "outcome": np.array([1, 1, 3]),
        "steps": steps,
        "episode_seed": np.array([5, 6, 7]),
        "outcome_names": np.array(
            ["running", "success", "collision", "timeout", "diverged"]
        ),
        "tolerance": np.array(0.3),
        "control_interval_s": np.array(0.25),
        "sea_x": side,
        "sea_y": side,
        "sea_elevation": 0.1 * np.cos(side)[None, :] + 0.0 * side[:, None],
    }


@pytest.fixture
def arena_trajectories(trajectories: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same three episodes, half as long, of a round robot among obstacles.

    In every layout there are four walls, a box and a round pillar; the box stands
    elsewhere in each, the last layout is without the pillar.
    """
    walls = [[3.05, 0, 1, 0], [-3.05, 0, 1, 0], [0, 2.05, 1, 0], [0, -2.05, 1, 0]]
    slanted = [np.cos(0.5), np.sin(0.5)]
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    data = {name: item for name, item in trajectories.items() if "sea" not in name}
    return data | {
        "position": 0.5 * data["position"],
        "goal": 0.5 * data["goal"],
        "action": np.zeros((6, 3), dtype=np.int64),
        "half_extent": np.array([3.0, 2.0]),
        "obstacles": np.array(
            [
                [*walls, [1.0, -1.0, 1.0, 0.0], [-2.0, 1.0, 1.0, 0.0]],
                [*walls, [1.0, 1.0, *slanted], [-2.0, 1.0, 1.0, 0.0]],
                [*walls, [-1.0, 1.0, 0.0, 1.0], [100.0, 100.0, 1.0, 0.0]],
            ]
        ),
        "obstacle_is_box": np.array([True] * 5 + [False]),
        "obstacle_half_size": np.array(
            [[0.05, 2.1], [0.05, 2.1], [3.1, 0.05], [3.1, 0.05], [0.6, 0.2], [0.3, 0.3]]
        ),
        "vehicle_outline": 0.11 * np.stack([np.cos(around), np.sin(around)], axis=-1)
        - [0.03, 0.0],
        "beam_angles": np.radians([-90.0, 0.0, 90.0]),
    }
