"""The indoor task: drive a wheeled robot with a lidar through a walled arena to a goal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from gdrl_tasks.indoor import lidar
from gdrl_tasks.indoor.arena import ARENAS
from gdrl_tasks.indoor.kernel import ahead_of, clearances_ahead, scan_ahead
from gdrl_tasks.indoor.options import IndoorOptions
from gdrl_tasks.indoor.robot import (
    BODY_X_M,
    BURGER_WHEEL_SPEED_M_S,
    FOOTPRINT_M,
    WHEEL_RADIUS_M,
    WHEEL_SEPARATION_M,
    model_xml,
    obstacle_geoms,
)
from gdrl_tasks.indoor.scenery import draw_scan
from gdrl_tasks.spec import Episode, TaskSpec, WorldArrays, WorldIndex
from gdrl_tasks.task import NavigationTask

COLLISION_MARGIN_M = 0.005
"""A footprint this near to an obstacle counts as touching it: walls are solid."""
DISTANCE_SCALE_M = 5.0
_FARTHEST_SEEN = 4.0
"""Largest goal distance that is observed, in units of the scale."""
_FIRST = np.zeros(1, dtype=np.int64)
_OVERSHOOT = 1.2
"""Largest speed in units of the commanded one, with a margin."""


class IndoorTask(NavigationTask):
    """A TurtleBot3 Burger in an arena; see the README of this folder for the model.

    Examples:
        >>> task = IndoorTask(IndoorOptions(num_beams=13))
        >>> task.spec.observation_size, task.spec.num_substeps, task.spec.action_size
        (15, 6, 5)
    """

    name = "indoor"
    model_fields = ("geom_pos", "geom_quat")

    def __init__(self, options: IndoorOptions | None = None) -> None:
        self.options = options = options or IndoorOptions()
        assert options.step_limit is not None
        self.arena = ARENAS[options.arena]()
        self.goal_tolerance_m = options.goal_tolerance_m
        self.progress_weight = options.progress_weight
        self.truncates_at_limit = options.at_limit == "truncated"
        is_discrete = options.actions == "discrete"
        self.spec = TaskSpec(
            observation={
                "goal_distance": (1, 0.0, _FARTHEST_SEEN),
                "goal_bearing": (1, -1.0, 1.0),
                "lidar": (options.num_beams, 0.0, 1.0),
            },
            action_size=len(options.turn_rates_deg_s) if is_discrete else 2,
            is_discrete=is_discrete,
            control_interval_s=options.control_interval_s,
            substep_s=options.substep_s,
            step_limit=options.step_limit,
            running_reward_limit=self.progress_weight
            * _OVERSHOOT
            * options.speed_m_s
            * options.control_interval_s,
        )
        self._angles = lidar.beam_angles(options.num_beams, options.field_of_view_deg)
        self._beams = np.stack([np.cos(self._angles), np.sin(self._angles)])
        self._shapes = self.arena.shapes.is_box, self.arena.shapes.half_size
        self._turn_rates = np.radians(options.turn_rates_deg_s)
        speeds = np.full(len(self._turn_rates), options.speed_m_s)
        self._discrete = self.wheel_rates(speeds, self._turn_rates)
        # Their numbers are the same in both models: geoms that are left out come later.
        self._geoms = obstacle_geoms(mujoco.MjModel.from_xml_string(self.xml()))

    @property
    def distance_scale_m(self) -> float:
        """The same in every arena, so that a policy can move between them."""
        return DISTANCE_SCALE_M

    def xml(self) -> str:
        """The arena and the robot."""
        return model_xml(
            self.arena.shapes,
            half_extent_m=self.arena.half_extent_m,
            substep_s=self.spec.substep_s,
            goal_tolerance_m=self.goal_tolerance_m,
        )

    def extra_arrays(self, num_worlds: int) -> WorldArrays:
        """Wheel speeds, obstacles and the last scan."""
        return {
            "control": np.zeros((num_worlds, 2)),
            "obstacles": np.zeros((num_worlds, len(self.arena.shapes), 4)),
            "scan": np.zeros((num_worlds, self.options.num_beams)),
            "scan_number": np.zeros(num_worlds, dtype=np.int64),
        }

    def draw_episode(self, seed: int) -> Episode:
        """A layout, a start at rest and a goal."""
        generator = np.random.default_rng(seed)
        footprint = FOOTPRINT_M + COLLISION_MARGIN_M
        scene = self.arena.draw(generator, footprint, self.goal_tolerance_m)
        ahead = np.array([math.cos(scene.heading_rad), math.sin(scene.heading_rad)])
        qpos = np.zeros(9)
        qpos[:2] = scene.start - BODY_X_M * ahead
        # Height at which the weight has pressed the tyres a little into the floor.
        qpos[2] = WHEEL_RADIUS_M - 0.0001
        qpos[3] = math.cos(0.5 * scene.heading_rad)
        qpos[6] = math.sin(0.5 * scene.heading_rad)
        arrays = {
            "goal": scene.goal,
            "obstacles": scene.places,
            "shortest_path": scene.shortest_path_m,
        }
        return Episode(qpos=qpos, qvel=np.zeros(8), arrays=arrays)

    def write_model_fields(
        self, fields: Mapping[str, np.ndarray], arrays: WorldArrays, ids: WorldIndex
    ) -> None:
        """Put walls and obstacles where the episode has them."""
        places = arrays["obstacles"][ids]
        rows = ids[:, None]
        fields["geom_pos"][rows, self._geoms, :2] = places[..., :2]
        half_yaw = 0.5 * np.arctan2(places[..., 3], places[..., 2])
        fields["geom_quat"][rows, self._geoms, 0] = np.cos(half_yaw)
        fields["geom_quat"][rows, self._geoms, 3] = np.sin(half_yaw)

    def set_action(self, arrays: WorldArrays, ids: WorldIndex, action: Any) -> None:
        """Wheel speeds of indices of turn rates ``[K]``, or of (v, omega) ``[K, 2]``."""
        if self.spec.is_discrete:
            arrays["control"][ids] = self._discrete[np.asarray(action, dtype=np.int64)]
            return
        action = np.clip(action, -1.0, 1.0)
        speed = 0.5 * (action[:, 0] + 1.0) * self.options.speed_m_s
        fastest_turn = np.abs(self._turn_rates).max()
        arrays["control"][ids] = self.wheel_rates(speed, action[:, 1] * fastest_turn)

    def wheel_rates(self, speed_m_s: np.ndarray, turn_rad_s: np.ndarray) -> np.ndarray:
        """Rates of the left and right wheel, rad/s, ``[K, 2]``, within their limit."""
        difference = 0.5 * WHEEL_SEPARATION_M * turn_rad_s
        rims = np.stack([speed_m_s - difference, speed_m_s + difference], axis=-1)
        if self.options.wheel_speed_limit is not None:
            fastest = np.abs(rims).max(axis=1, keepdims=True)
            rims *= np.minimum(1.0, BURGER_WHEEL_SPEED_M_S / np.maximum(fastest, 1e-9))
        return rims / WHEEL_RADIUS_M

    def body_centre(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middle of the footprint, and the lidar, ``[K, 2]``; heading ``[K]``."""
        axle, yaw = self.planar_pose(qpos)
        return ahead_of(axle, yaw, BODY_X_M), yaw

    def collides(
        self, arrays: WorldArrays, ids: WorldIndex, position: np.ndarray, yaw: np.ndarray
    ) -> np.ndarray:
        """Mask of robots whose footprint touches a wall or an obstacle, ``[K]``."""
        room = clearances_ahead(
            position, yaw, BODY_X_M, ids, arrays["obstacles"], *self._shapes
        )
        return room <= FOOTPRINT_M + COLLISION_MARGIN_M

    def sense(
        self, arrays: WorldArrays, ids: WorldIndex, position: np.ndarray, yaw: np.ndarray
    ) -> None:
        """Make a scan in worlds where a new one is due."""
        number = arrays["steps"][ids]
        if self.options.scan_hold:
            time_s = number * self.spec.control_interval_s
            is_first = number == 0
            number = np.floor(time_s / lidar.SCAN_INTERVAL_S + 1e-9).astype(np.int64)
            due = is_first | (number > arrays["scan_number"][ids])
            ids, number = ids[due], number[due]
            position, yaw = position[due], yaw[due]
        ranges = self._cast(arrays, ids, position, yaw)
        if self.options.range_noise:
            noise = lidar.range_noise(ranges, arrays["episode_seed"][ids], number)
            # A beam that hits nothing reads the farthest range, without errors.
            ranges += np.where(ranges < lidar.FARTHEST_M, noise, 0.0)
            np.clip(ranges, lidar.NEAREST_M, lidar.FARTHEST_M, out=ranges)
        arrays["scan"][ids] = ranges
        arrays["scan_number"][ids] = number

    def observe_extra(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray, qvel: np.ndarray
    ) -> dict[str, np.ndarray]:
        """The last scan, from right to left, in units of the farthest range."""
        return {"lidar": arrays["scan"][ids] / lidar.FARTHEST_M}

    def draw_scenery(self, physics: Any, arrays: WorldArrays) -> None:
        """Draw the beams with true ranges from where the robot is drawn.

        The last scan is not drawn: it may be older, and it may have errors.
        """
        qpos = physics.data.qpos[None]
        if not np.isfinite(qpos).all():
            return
        position, yaw = self.planar_pose(qpos)
        draw_scan(physics, self._cast(arrays, _FIRST, position, yaw)[0], self._angles)

    def _cast(
        self, arrays: WorldArrays, ids: WorldIndex, position: np.ndarray, yaw: np.ndarray
    ) -> np.ndarray:
        """True ranges of the beams from where robots are, metres, ``[K, B]``."""
        return scan_ahead(
            position,
            yaw,
            BODY_X_M,
            self._beams,
            ids,
            arrays["obstacles"],
            *self._shapes,
            (lidar.NEAREST_M, lidar.FARTHEST_M),
        )
