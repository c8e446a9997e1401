"""The map stays clean: what moved, went, is there twice or was learnt from a false pose leaves it; the rest stays."""

from dataclasses import replace

import numpy as np
import pytest

from constellations import MAP_COLUMNS, frame_of, noise, points_of, scattered, sensor_covariances
from trifix.errors import ConfigError
from trifix.geometry.pose import Pose, exp_rotation
from trifix.records import Event, Fix, Frame, ReferenceMap, SensorPoints, TargetState
from trifix.stages.tend import Care, Hand, Lesson, TendOptions, strays, without
from trifix.stages.update import update

HAND = Hand(2000.0, 8.0, 0.3)
POSE_COV = np.diag([0.02**2] * 3 + [5e-5**2] * 3)
GATE_SIGMAS = 4.0


def sweeping(k: int) -> Pose:
    """T_world_sensor in frame k: 450 mm before the origin, swinging to and fro by some 15°, slowly."""
    about = np.array([0.25 * np.sin(k / 12), 0.25 * np.cos(k / 17), 0.02 * np.sin(k / 9)])
    R = exp_rotation(about)
    return Pose(R, -R @ np.array([0.0, 0.0, 450.0]))


class World:
    """A map that grows by what a sensor sees, identified as verification would: by the nearest within the gate."""

    def __init__(self, seed: int = 0, options: TendOptions | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        self.care = Care(options or TendOptions())
        self.map = ReferenceMap.empty()
        self.next_id = 0
        self.events: list[tuple[int, Event]] = []

    def look(self, k: int, xyz_mm: np.ndarray, T: Pose | None = None, clutter: int = 0) -> None:
        """Learns from frame k, in which some places are seen beside so many points that are none."""
        T = T or sweeping(k)
        there = T.inverse().apply(np.vstack([xyz_mm, self.rng.uniform(-70, 70, (clutter, 3))]))
        cov = sensor_covariances(there)
        self.learn(frame_of(k, points_of(there + noise(self.rng, cov), cov), rig=None), T)

    def learn(self, frame: Frame, T: Pose) -> None:
        points = frame.content
        assert isinstance(points, SensorPoints)
        fix = identified(points, self.map, T)
        before = self.map.rows(fix.target)
        self.map, added = update(self.map, points, None, fix, frame.index, None, self.next_id)
        self.next_id += len(added)
        self.map, events = self.care.tend(before, self.map, added, points, fix, frame, HAND)
        self.events += [(frame.index, event) for event in events]

    def told(self, *kinds: str) -> list[tuple[int, Event]]:
        return [(k, event) for k, event in self.events if event.event in kinds]

    def states_at(self, xyz_mm: np.ndarray, within_mm: float = 0.15) -> set[str]:
        """States of the targets that the map has at a place."""
        there = np.linalg.norm(self.map.xyz_mm - xyz_mm, axis=1) < within_mm
        return {TargetState(s).name for s in self.map.state[there]} - {"removed"}


def identified(points: SensorPoints, map: ReferenceMap, T: Pose) -> Fix:
    """The points at a known pose, each as the nearest target within the gate, none twice."""
    alive = np.flatnonzero(map.alive)
    world = T.apply(points.xyz_mm)
    r = map.xyz_mm[alive] - world[:, None]
    S = map.cov_mm2[alive] + (T.R @ points.cov_mm2 @ T.R.T)[:, None] + 0.03**2 * np.eye(3)
    d2 = np.einsum("nki,nki->nk", r, np.linalg.solve(S, r[..., None])[..., 0])
    is_pair = (d2 < GATE_SIGMAS**2) & (d2 == d2.min(axis=1, keepdims=True, initial=np.inf)) & (d2 == d2.min(axis=0))
    point, nearest = np.nonzero(is_pair)
    target = alive[nearest]
    return Fix(T, POSE_COV, point, target, np.linalg.norm(map.xyz_mm[target] - world[point], axis=1), 1e-20)


@pytest.fixture
def places() -> np.ndarray:
    """Thirty targets, none nearer to another than 22 mm."""
    return scattered(np.random.default_rng(5), 30, (170.0, 150.0, 40.0), apart_mm=22.0)


def moved(places: np.ndarray, row: int, by_mm: float) -> np.ndarray:
    after = places.copy()
    after[row] += by_mm * np.array([0.6, 0.8, 0.0])
    return after


# --- what stays ------------------------------------------------------------------------------------------------------


def test_a_map_of_what_stays_stays_however_cluttered(places: np.ndarray) -> None:
    world = World()
    for k in range(100):
        seen = world.rng.random(len(places)) > 0.04
        world.look(k, places[seen], clutter=4)
    assert world.told("target_moved", "target_merged", "target_quarantined", "target_removed", "update_undone") == []
    assert all(world.states_at(each) == {"trusted"} for each in places)


def test_a_target_seen_from_one_direction_alone_is_not_trusted(places: np.ndarray) -> None:
    world = World()
    for k in range(6):
        world.look(k, places, T=sweeping(0))
    assert set(world.map.state[:30]) == {TargetState.provisional}
    world.look(6, places, T=sweeping(3))
    assert set(world.map.state[:30]) == {TargetState.trusted}


def test_what_a_hand_hides_for_a_while_stays(places: np.ndarray) -> None:
    world = World()
    hidden = np.linalg.norm(places - places[4], axis=1).argsort()[:5]
    for k in range(100):
        world.look(k, np.delete(places, hidden, axis=0) if 50 <= k < 85 else places)
    assert world.events == []
    assert all(world.states_at(each) == {"trusted"} for each in places)


def test_what_is_out_of_the_directions_it_was_seen_from_is_not_missed(places: np.ndarray) -> None:
    world = World()
    for k in range(120):
        T = sweeping(k)
        world.look(k, places if T.t_mm[0] > 0 else np.delete(places, 3, axis=0), T)
    assert world.events == []


# --- what moves or goes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("by_mm", "within_frames"), [(0.16, 40), (0.2, 35), (0.3, 6), (2.0, 6), (7.0, 6), (20.0, 40)])
def test_a_move_is_told_with_its_size_and_the_target_enters_again(
    places: np.ndarray, by_mm: float, within_frames: int
) -> None:
    world, after = World(), moved(places, 7, by_mm)
    for k in range(50 + within_frames + 20):
        world.look(k, places if k < 50 else after)
    (k, event), *others = world.told("target_moved")
    assert (event.target, others) == (7, [])
    assert 50 < k < 50 + within_frames
    size_mm = float(event.detail.split(" mm")[0].split()[-1])
    assert abs(size_mm - by_mm) < 0.06
    assert [event.target for _, event in world.told("target_quarantined")] == [7]
    assert world.map.state[7] == TargetState.quarantined
    assert "trusted" in world.states_at(after[7])
    assert len(world.events) == 2


def test_targets_that_move_while_most_stay_are_all_told(places: np.ndarray) -> None:
    world, after = World(), places.copy()
    after[:6] += [0.0, 3.0, 0.0]
    for k in range(80):
        world.look(k, places if k < 50 else after)
    assert sorted(event.target or 0 for _, event in world.told("target_moved")) == [0, 1, 2, 3, 4, 5]


def test_a_removed_target_fades_and_nothing_else_does(places: np.ndarray) -> None:
    world = World()
    for k in range(130):
        world.look(k, np.delete(places, 11, axis=0) if k >= 50 else places)
    ((k, event),) = world.events
    assert (event.event, event.target) == ("target_removed", 11)
    assert 85 < k < 110
    assert "after frame 49" in event.detail
    assert world.map.state[11] == TargetState.removed


def test_a_target_put_back_enters_again(places: np.ndarray) -> None:
    world = World()
    for k in range(140):
        world.look(k, np.delete(places, 11, axis=0) if 40 <= k < 120 else places)
    assert [event.event for _, event in world.events] == ["target_removed"]
    assert world.states_at(places[11]) == {"trusted"}


def test_frames_taught_late_take_nothing_away(places: np.ndarray) -> None:
    world = World()
    for k in range(40):
        world.look(k, places)
    for k in range(30, 0, -1):
        world.look(k, moved(np.delete(places, 3, axis=0), 7, 5.0))
    assert world.events == []


# --- what is there twice ---------------------------------------------------------------------------------------------


def test_two_targets_that_take_turns_become_the_older_one(places: np.ndarray) -> None:
    world = World()
    for k in range(20):
        world.look(k, places)
    twin = ReferenceMap.given(
        places[[9]] + [0.5, 0.0, 0.0], world.map.cov_mm2[[9]], world.map.view[[9]], np.array([99])
    )
    world.map = ReferenceMap(*(np.concatenate([getattr(world.map, f), getattr(twin, f)]) for f in MAP_COLUMNS))
    for k in range(20, 60):  # the targets are seen now as the one, now as the other
        seen = places.copy()
        seen[9] += [0.5 * (k % 2), 0.0, 0.0]
        world.look(k, seen)
        if world.events:
            break
    ((k, event),) = world.events
    assert (event.event, event.target) == ("target_merged", 99)
    assert event.detail.startswith("into target 9, 0.5")
    assert world.map.state[-1] == TargetState.removed


def test_a_map_whose_ends_met_with_drift_is_merged_not_moved(places: np.ndarray) -> None:
    world = World()
    drifted = places + [0.0, 3.0, 1.0]
    for k in range(100):
        world.look(k, places if k < 50 else drifted)
    assert world.told("target_moved", "target_removed", "target_quarantined") == []
    merged = world.told("target_merged")
    assert all(event.target is not None and event.target >= 30 for _, event in merged), "the older ones stay"
    assert len(merged) >= 28
    assert world.map.alive.sum() <= 32


def test_targets_seen_together_are_never_one(places: np.ndarray) -> None:
    close = np.vstack([places, places[2] + [3.0, 0.0, 0.0]])
    world = World()
    for k in range(80):
        shown = np.ones(31, dtype=bool)
        shown[2 if k % 2 else 30] = k < 20
        world.look(k, close[shown])
    assert world.told("target_merged") == []


# --- what is undone --------------------------------------------------------------------------------------------------


def test_taking_a_lesson_back_leaves_the_map_as_if_it_had_not_been(places: np.ndarray) -> None:
    world = World()
    for k in range(4):
        world.look(k, places[:25])
    never = map = world.map
    frames = [seen_frame(world, 4, places + 0.05), *(seen_frame(world, k, places[:25]) for k in (5, 6))]
    for frame in frames:
        points, fix = frame.content, identified(frame.content, map, sweeping(frame.index))
        before = map.rows(fix.target)
        map, added = update(map, points, None, fix, 0, None, 99)
        if frame.index == 4:
            row = np.concatenate([fix.target, added])
            lesson = Lesson(4, frame.timestamp_ns, fix, row, before, map.rows(row))
        else:
            never, _ = update(never, points, None, fix, 0, None, 99)
    taken_back = without(map, lesson)
    np.testing.assert_allclose(taken_back.xyz_mm[:25], never.xyz_mm[:25], atol=1e-9)
    np.testing.assert_allclose(taken_back.cov_mm2[:25], never.cov_mm2[:25], atol=1e-12)
    np.testing.assert_array_equal(taken_back.sightings[:25], never.sightings[:25])
    np.testing.assert_array_equal(taken_back.state[:25], never.state[:25])
    assert len(map) == 30
    assert set(taken_back.state[25:]) == {TargetState.removed}
    assert np.abs(map.xyz_mm[:25] - taken_back.xyz_mm[:25]).max() > 1e-3


def test_a_stray_is_undone_when_the_noise_scale_has_changed_since(places: np.ndarray) -> None:
    worlds = []
    for ratio in (1.0, 2.0):
        world = World()
        for k in range(12):
            T = off(sweeping(k), 60.0) if k == 10 else sweeping(k)
            world.learn(seen_frame(world, k, places), T)
            if k == 10:
                world.map = replace(world.map, cov_mm2=world.map.cov_mm2 * ratio**2)
                world.care.rescale(ratio)
        assert len(world.told("update_undone")) == 1
        worlds.append(world)
    one, other = worlds
    assert one.map.alive.sum() == other.map.alive.sum() == 30
    assert np.linalg.norm(other.map.xyz_mm[:30] - places, axis=1).max() < 0.2


def seen_frame(world: World, k: int, xyz_mm: np.ndarray) -> Frame:
    there = sweeping(k).inverse().apply(xyz_mm)
    cov = sensor_covariances(there)
    return frame_of(k, points_of(there + noise(world.rng, cov), cov), rig=None)


def off(T: Pose, by_mm: float) -> Pose:
    return Pose(T.R, T.t_mm + [by_mm, 0.0, 0.0])


@pytest.mark.parametrize("run", [1, 3])
def test_a_pose_there_and_back_is_undone_with_all_that_it_taught(places: np.ndarray, run: int) -> None:
    world = World()
    for k in range(40):
        is_stray = 30 <= k < 30 + run
        if is_stray:  # nothing is identified: whatever it sees would enter as new
            world.learn(seen_frame(world, k, places), off(sweeping(k), 60.0))
        else:
            world.look(k, places)
    undone = world.told("update_undone")
    assert [k for k, _ in undone] == [30 + run] * run
    assert [event.detail.split(":")[0] for _, event in undone] == [f"frame {30 + j}" for j in range(run)]
    assert world.map.alive.sum() == 30
    assert all(world.states_at(each) == {"trusted"} for each in places)


def journal(poses: list[Pose], times: list[float]) -> list[Lesson]:
    nothing = ReferenceMap.empty()
    none = np.zeros(0, dtype=np.int64)
    return [
        Lesson(k, int(1e9 * t), Fix(T, POSE_COV, none, none, np.zeros(0), 1e-20), none, nothing, nothing)
        for k, (T, t) in enumerate(zip(poses, times, strict=True))
    ]


def test_a_sensor_carried_elsewhere_and_a_hand_that_turns_round_are_no_strays() -> None:
    steady = [sweeping(k) for k in range(8)]
    carried = steady[:5] + [off(T, 80.0) for T in steady[5:]]
    times = [0.05 * k for k in range(8)]
    to_and_fro = [Pose(np.eye(3), np.array([25.0 * min(k, 8 - k), 0.0, 0.0])) for k in range(8)]
    late = [*times[:5], 2.0, 2.05, 2.1]
    assert strays(journal(steady, times), HAND, 1e-12)[0] == []
    assert all(strays(journal(carried[:n], times[:n]), HAND, 1e-12)[0] == [] for n in range(1, 9))
    assert all(strays(journal(to_and_fro[:n], times[:n]), HAND, 1e-12)[0] == [] for n in range(1, 9))
    there_and_back = [*steady[:5], off(steady[5], 80.0), *steady[6:]]
    assert all(strays(journal(there_and_back[:n], late[:n]), HAND, 1e-12)[0] == [] for n in range(1, 9))
    found, chi2 = strays(journal(there_and_back[:7], times[:7]), HAND, 1e-12)
    assert [lesson.frame for lesson in found] == [5]
    assert 100 < chi2 < 300


# --- options ---------------------------------------------------------------------------------------------------------


def test_without_tending_the_map_keeps_everything(places: np.ndarray) -> None:
    world = World(options=TendOptions(tends=False))
    for k in range(60):
        world.look(k, places if k < 20 else moved(places, 7, 3.0))
    assert world.events == []
    assert world.map.alive.sum() == 31


@pytest.mark.parametrize(
    "values",
    [
        {"max_p_still": 0.0},
        {"max_p_hand": 1.0},
        {"moved_after": 0},
        {"removed_after": 0.0},
        {"min_apart": 1.0},
        {"remembered": -1},
    ],
)
def test_impossible_options_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="tend"):
        replace(TendOptions(), **values)  # type: ignore[arg-type]
