"""The water task: steer a twin-thruster vessel through waves to a goal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from gdrl_tasks.kernels import upside_down
from gdrl_tasks.spec import Episode, TaskSpec, WorldArrays, WorldIndex
from gdrl_tasks.task import NavigationTask
from gdrl_tasks.water import waves
from gdrl_tasks.water.hull import make_hull
from gdrl_tasks.water.kernel import sea_arrays, substep, substep_constants
from gdrl_tasks.water.model import model_xml
from gdrl_tasks.water.options import EXTRA_OBSERVATIONS, WaterOptions
from gdrl_tasks.water.scenery import draw_sea_surface, note_track

# Port and starboard commands of the seven discrete actions, hard right to hard left
# (the seven of Marchesini et al. 2021, as thruster pairs).
DISCRETE_COMMANDS = np.array(
    [[1.0, -1.0], [1.0, 0.0], [1.0, 0.7], [1.0, 1.0], [0.7, 1.0], [0.0, 1.0], [-1.0, 1.0]]
)

FASTEST_M_S = 4.0


class WaterTask(NavigationTask):
    """A vessel in waves; see the README of this folder for the model and its sources.

    Examples:
        >>> task = WaterTask(WaterOptions(sea="calm"))
        >>> task.spec.observation_size, task.spec.num_substeps
        (3, 8)
    """

    name = "water"
    has_substep_forces = True

    def __init__(self, options: WaterOptions | None = None) -> None:
        self.options = options = options or WaterOptions()
        self.hull = make_hull()
        # The difficulty has filled in the options that were not given.
        assert options.goal_distance_m is not None
        assert options.goal_tolerance_m is not None
        assert options.sea is not None
        assert options.progress_weight is not None
        self.goal_distance_m = options.goal_distance_m
        self.goal_tolerance_m = options.goal_tolerance_m
        self._sea = waves.SEAS[options.sea]
        self.progress_weight = options.progress_weight
        self.truncates_at_limit = options.at_limit == "truncated"
        observation = {
            "goal_distance": (1, 0.0, 10.0),
            "goal_bearing": (1, -1.0, 1.0),
            "pitch": (1, -0.5 * math.pi, 0.5 * math.pi),
        }
        for extra in options.extra_observations:
            observation[extra] = EXTRA_OBSERVATIONS[extra]
        is_discrete = options.actions == "discrete"
        self.spec = TaskSpec(
            observation=observation,
            action_size=len(DISCRETE_COMMANDS) if is_discrete else 2,
            is_discrete=is_discrete,
            control_interval_s=options.control_interval_s,
            substep_s=options.substep_s,
            step_limit=options.step_limit,
            # Above what thrust, waves and current can cause: 3.6 m/s in the highest sea.
            running_reward_limit=self.progress_weight
            * (FASTEST_M_S + options.current_m_s)
            * options.control_interval_s,
        )
        self._constants = substep_constants(
            self.hull, options.substep_s, options.dead_zone_compensated
        )

    @property
    def distance_scale_m(self) -> float:
        """The farthest goal is observed at distance 1."""
        return self.goal_distance_m[1]

    @property
    def rest_height_m(self) -> float:
        """Height of the centre of gravity above still water when afloat."""
        return -self.hull.points[0, 2] - 0.5 * self.hull.draft_m

    def xml(self) -> str:
        """The hull, a goal marker and a drawn sea."""
        return model_xml(
            self.hull,
            substep_s=self.spec.substep_s,
            farthest_goal_m=self.goal_distance_m[1],
            goal_tolerance_m=self.goal_tolerance_m,
        )

    def note_scenery(self, physics: Any) -> None:
        """Remember where the vessel was, for its wake."""
        note_track(physics)

    def draw_scenery(self, physics: Any, arrays: WorldArrays) -> None:
        """Update the drawn sea, the floating goal and the chase camera."""
        sea = {name: arrays[name] for name in waves.SEA_FIELDS}
        # The waves travel in the water, and so with the current.
        carried = arrays["current"] * physics.data.time
        sea["phase"] = (
            sea["phase"]
            - sea["wavenumber_x"] * carried[:, 0:1]
            - sea["wavenumber_y"] * carried[:, 1:2]
        )
        draw_sea_surface(physics, arrays, sea)

    def extra_arrays(self, num_worlds: int) -> WorldArrays:
        """Sea, current and thrusters."""
        shape = (num_worlds, self.options.wave_components)
        arrays: WorldArrays = {name: np.zeros(shape) for name in waves.SEA_FIELDS}
        for name in ("current", "thrust", "command"):
            arrays[name] = np.zeros((num_worlds, 2))
        for name in ("significant_wave_height", "peak_period", "wave_direction"):
            arrays[name] = np.zeros(num_worlds)
        return arrays

    def draw_episode(self, seed: int) -> Episode:
        """A start at the origin with any heading, a goal, a sea and a current."""
        options = self.options
        generator = np.random.default_rng(seed)
        heading, bearing, direction, current = generator.uniform(-math.pi, math.pi, 4)
        distance = generator.uniform(self.goal_distance_m[0], self.goal_distance_m[1])
        height, period = self._draw_sea_state(generator)
        sea = waves.draw_sea(
            generator,
            height_m=height,
            period_s=period,
            direction_rad=direction,
            num_components=options.wave_components,
            shortest_wave_m=2.0 * self.hull.spacing_m,
            depth_m=0.5 * self.hull.draft_m,
        )
        arrays = sea | {
            "goal": distance * np.array([math.cos(bearing), math.sin(bearing)]),
            "current": options.current_m_s
            * np.array([math.cos(current), math.sin(current)]),
            "significant_wave_height": height,
            "peak_period": period,
            "wave_direction": direction,
        }
        qpos, qvel = np.zeros(7), np.zeros(6)
        pushing = sea["amplitude"] * sea["decay"]
        cosine, sine = np.cos(sea["phase"]), np.sin(sea["phase"])
        qpos[2] = self.rest_height_m + np.sum(pushing * sea["decay"] * cosine)
        qpos[3], qpos[6] = math.cos(0.5 * heading), math.sin(0.5 * heading)
        # At rest relative to the water, that is, moving with it.
        along = pushing * sea["omega"] / np.hypot(sea["wavenumber_x"], sea["wavenumber_y"])
        qvel[0] = arrays["current"][0] + np.sum(along * sea["wavenumber_x"] * cosine)
        qvel[1] = arrays["current"][1] + np.sum(along * sea["wavenumber_y"] * cosine)
        qvel[2] = np.sum(pushing * sea["omega"] * sine)
        return Episode(qpos=qpos, qvel=qvel, arrays=arrays)

    def _draw_sea_state(self, generator: np.random.Generator) -> tuple[float, float]:
        preset = self._sea
        wind, fetch = generator.uniform(size=2)
        if preset is None:
            height, period = 0.0, 1.0
        else:
            low, high = preset.wind_m_s
            wind = low + (high - low) * wind
            low, high = preset.fetch_m
            height, period = waves.fetch_limited_sea(wind, low * (high / low) ** fetch)
        if self.options.significant_wave_height_m is not None:
            height = self.options.significant_wave_height_m
        return height, self.options.peak_period_s or period

    def set_action(self, arrays: WorldArrays, ids: WorldIndex, action: Any) -> None:
        """Thruster commands in [-1, 1], ``[K, 2]``, or indices of the seven, ``[K]``."""
        if self.spec.is_discrete:
            arrays["command"][ids] = DISCRETE_COMMANDS[np.asarray(action, dtype=np.int64)]
        else:
            arrays["command"][ids] = np.clip(action, -1.0, 1.0)

    def apply_forces(
        self,
        arrays: WorldArrays,
        ids: WorldIndex,
        qpos: np.ndarray,
        qvel: np.ndarray,
        time_s: np.ndarray,
        xfrc_applied: np.ndarray,
    ) -> None:
        """Water and thrusters; ``xfrc_applied`` is ``[W, bodies, 6]``, the hull last."""
        self.bind_forces(arrays, qpos, qvel, time_s, xfrc_applied)(ids)

    def bind_forces(
        self,
        arrays: WorldArrays,
        qpos: np.ndarray,
        qvel: np.ndarray,
        time_s: np.ndarray,
        xfrc_applied: np.ndarray,
    ) -> Callable[[WorldIndex], None]:
        """:meth:`apply_forces` as a function of the worlds alone, ``[K]``."""
        own = (arrays["thrust"], arrays["command"], arrays["current"], sea_arrays(arrays))
        state = (qpos, qvel, time_s, xfrc_applied[:, -1])
        return lambda ids: substep(ids, *state, *own, self._constants)

    def capsizes(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray
    ) -> np.ndarray:
        """Mask of hulls that heel or pitch by more than 90 degrees, ``[K]``."""
        return upside_down(qpos)

    def observe_extra(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray, qvel: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Pitch (radians, bow down positive) and the options."""
        w, x, y, z = qpos[:, 3:7].T
        values = {"pitch": np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))}
        extras = self.options.extra_observations
        if "roll" in extras:
            values["roll"] = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        if "velocity" in extras:
            _, yaw = self.planar_pose(qpos)
            ahead = qvel[:, 0] * np.cos(yaw) + qvel[:, 1] * np.sin(yaw)
            left = qvel[:, 1] * np.cos(yaw) - qvel[:, 0] * np.sin(yaw)
            values["velocity"] = np.stack([ahead, left, qvel[:, 5]], axis=-1)
        if "time_left" in extras:
            values["time_left"] = 1.0 - arrays["steps"][ids] / self.spec.step_limit
        return values
