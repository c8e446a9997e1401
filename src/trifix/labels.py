"""What is known of the targets' labels, and what they say of a hypothesis.

A label is evidence, not truth. Hypotheses that contradict labels are tried last, and all of them are tried. Kept beside
the map of an island, by the identities of its targets.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from trifix.geometry.pose import Pose
from trifix.records import Identification, ReferenceMap, SensorPoints


class TargetLabels:
    """The label of each target that most of its sightings bore.

    One candidate and one count a target: the majority vote of R. Boyer and J Moore (1981).
    """

    def __init__(self) -> None:
        self._label = np.zeros(0, dtype=np.int64)
        self._votes = np.zeros(0, dtype=np.int64)

    def of(self, map: ReferenceMap) -> Int[np.ndarray, "k"]:
        """The label of each target of a map; -1 where none is known."""
        label = np.full(len(map), -1)
        known = np.flatnonzero(map.id < len(self._label))
        label[known] = np.where(self._votes[map.id[known]] > 0, self._label[map.id[known]], -1)
        return label

    def learn(
        self, map: ReferenceMap, points: SensorPoints, point: Int[np.ndarray, "c"], target: Int[np.ndarray, "c"]
    ) -> None:
        """Takes note of points (rows) that were identified as targets (rows)."""
        has = points.label[point] >= 0
        if not has.any():
            return
        id, label = map.id[target[has]], points.label[point[has]]
        if (least := int(id.max()) + 1) > len(self._label):
            more = np.zeros(2 * least - len(self._label), dtype=np.int64)
            self._label, self._votes = np.concatenate([self._label, more]), np.concatenate([self._votes, more])
        is_same = (self._label[id] == label) | (self._votes[id] == 0)
        self._label[id] = np.where(is_same, label, self._label[id])
        self._votes[id] += np.where(is_same, 1, -1)

    def enter(self, map: ReferenceMap, points: SensorPoints, T_world_sensor: Pose, added: Int[np.ndarray, "a"]) -> None:
        """The same of targets that have just entered the map, each where a point was."""
        if len(added) and (points.label >= 0).any():
            xyz_mm = T_world_sensor.apply(points.xyz_mm)
            point = [int(((xyz_mm - each) ** 2).sum(axis=1).argmin()) for each in map.xyz_mm[added]]
            self.learn(map, points, np.array(point), added)


def contradict(label: Int[np.ndarray, "*s"], other: Int[np.ndarray, "*s"]) -> Bool[np.ndarray, "*s"]:
    """Whether labels exclude each other: both known, and different."""
    return np.asarray((label >= 0) & (other >= 0) & (label != other))


def by_label(
    identification: Identification, points: SensorPoints, target_label: Int[np.ndarray, "k"]
) -> Iterator[Identification]:
    """The hypotheses that no label contradicts, and then the others.

    What is reckoned with for chance is what was tried, whatever chose it; what chance is expected to bring stays whole.
    """
    point, target = identification.point, identification.target
    is_doubtful = contradict(points.label[point], target_label[target]).any(axis=1)
    if not is_doubtful.any() or is_doubtful.all():
        yield identification
        return
    yield replace(identification, point=point[~is_doubtful], target=target[~is_doubtful])
    yield replace(
        identification, point=point[is_doubtful], target=target[is_doubtful], comparisons=0, expected_by_chance=0.0
    )
