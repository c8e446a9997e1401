"""The last fixes -> where the sensor should be now, and how sure that is. Knows no point and no map.

A hand moves smoothly: its velocity persists and is disturbed by accelerations. The prediction is evidence for a pose
near it, never a proof: see ``verify``.
"""

from dataclasses import dataclass

import numpy as np

from trifix.errors import ConfigError
from trifix.geometry.pose import Pose
from trifix.records import Prediction


@dataclass(frozen=True, slots=True)
class PredictOptions:
    """How a hand may move."""

    max_gap_s: float = 1.0
    """No prediction later than this after the last fix (s)."""
    speed_mm_s: float = 250.0
    """Standard deviation of the velocity along each axis, while it is unknown (mm/s)."""
    turn_rad_s: float = 0.7
    """Standard deviation of the turning rate about each axis, while it is unknown (rad/s)."""
    acceleration_mm_s2: float = 2000.0
    """Standard deviation of the acceleration along each axis (mm/s²)."""
    angular_acceleration_rad_s2: float = 8.0
    """Standard deviation of the angular acceleration about each axis (rad/s²)."""

    def __post_init__(self) -> None:
        if self.max_gap_s < 0:
            raise ConfigError(f"predict.max_gap_s is {self.max_gap_s}, expected a duration in seconds, 0 for never.")
        rates = (self.speed_mm_s, self.turn_rad_s, self.acceleration_mm_s2, self.angular_acceleration_rad_s2)
        if min(rates) <= 0:
            raise ConfigError("predict.speed_mm_s, turn_rad_s and the accelerations must be positive.")


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The newest fixes, as far as a prediction needs them."""

    newest_ns: int
    """Time of the newest fix (ns)."""
    newest: Pose
    """``T_world_sensor`` of the newest fix."""
    before_ns: int
    """Time of the fix before it, or of the newest again where it is the first."""
    before: Pose
    """``T_world_sensor`` of that fix."""


def follow(motion: Motion | None, timestamp_ns: int, T_world_sensor: Pose) -> Motion:
    """The motion after one more fix."""
    if motion is None:
        return Motion(timestamp_ns, T_world_sensor, timestamp_ns, T_world_sensor)
    return Motion(timestamp_ns, T_world_sensor, motion.newest_ns, motion.newest)


def predict(motion: Motion | None, timestamp_ns: int, options: PredictOptions) -> Prediction | None:
    """The pose at a time by constant velocity, or where it was; None when the last fix is too old.

    Whichever is surer: after a single fix, or a long while, no velocity is known any more.
    """
    if motion is None:
        return None
    gap_s = 1e-9 * (timestamp_ns - motion.newest_ns)
    if not 0 < gap_s <= options.max_gap_s:
        return None
    resting = gap_s * np.repeat([options.speed_mm_s, options.turn_rad_s], 3)
    step_s = 1e-9 * (motion.newest_ns - motion.before_ns)
    if 0 < step_s <= options.max_gap_s:
        velocity = (motion.before.inverse() @ motion.newest).log() / step_s
        reach_s2 = gap_s * (gap_s + step_s)  # twice the error that a constant acceleration makes
        sigma = 0.5 * reach_s2 * np.repeat([options.acceleration_mm_s2, options.angular_acceleration_rad_s2], 3)
        if (sigma < resting).all():
            pace = velocity * gap_s
            any_way = np.repeat([np.linalg.norm(pace[:3]), np.linalg.norm(pace[3:])], 3)
            turned = Prediction(motion.newest, np.diag(sigma**2 + any_way**2))
            return Prediction(motion.newest @ Pose.exp(pace), np.diag(sigma**2), turned)
    return Prediction(motion.newest, np.diag(resting**2))


def across(link: Prediction, T: Pose, is_to_world: bool) -> Prediction:
    """Where a sensor is in the world whose pose on an island is known, or the other way round."""
    T_world_island = link.T_world_sensor
    there = T_world_island @ T if is_to_world else T_world_island.inverse() @ T
    A = (T if is_to_world else there).inverse().adjoint()
    return Prediction(there, A @ link.cov @ A.T)
