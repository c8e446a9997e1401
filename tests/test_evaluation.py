import copy
import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D

from trifix.errors import RecordingError
from trifix.evaluation import (
    Evaluation,
    Spread,
    compare_poses,
    compare_targets,
    consistency,
    evaluate,
    normalised_errors,
    table,
)
from trifix.files.calibrations import write_rig
from trifix.files.maps import write_map
from trifix.files.recordings import write_dots, write_frames, write_points
from trifix.files.trajectories import POSES_HEADER, poses_row, tum_row
from trifix.files.truth import read_truth
from trifix.geometry.alignment import align
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose
from trifix.records import ReferenceMap, StereoDots
from trifix.sources.simulation import simulate, simulate_frames

SIGMA_MM = 0.02


def wandering_poses(n: int, seed: int = 0) -> list[Pose]:
    """A hand that moves along x, 400 mm before the plane z = 0, and looks at it."""
    rng = np.random.default_rng(seed)
    delta = np.c_[rng.normal(0, 15.0, (n, 3)), rng.normal(0, 0.08, (n, 3))]
    places = np.c_[np.linspace(0, 600, n), np.full(n, 100.0), np.full(n, -400.0)]
    return [Pose(np.eye(3), place) @ Pose.exp(d) for place, d in zip(places, delta, strict=True)]


def moved(poses: list[Pose], T: Pose) -> list[Pose]:
    return [T @ each for each in poses]


# --- on arrays -------------------------------------------------------------------------------------------------------


def test_the_same_poses_in_other_coordinates_have_no_error() -> None:
    truth = wandering_poses(40)
    result = compare_poses(moved(truth, Pose.exp(np.array([500.0, -90, 20, 1.0, -2.0, 0.5]))), truth)
    assert result.error_mm.max() < 1e-9
    assert result.error_deg.max() < 1e-9
    assert not result.is_wrong.any()
    assert result.ape_rmse_mm < 1e-9


def test_with_the_map_given_nothing_is_aligned() -> None:
    truth = wandering_poses(10)
    result = compare_poses(moved(truth, Pose(np.eye(3), np.array([0.0, 7.0, 0.0]))), truth, is_map_given=True)
    np.testing.assert_allclose(result.error_mm, 7.0, atol=1e-9)
    assert result.is_wrong.all()
    assert abs(result.ape_rmse_mm - 7.0) < 1e-9


@pytest.mark.parametrize("share", [0.1, 0.3])
@pytest.mark.parametrize("is_one_block", [True, False], ids=["all alike", "each its own way"])
def test_wrong_poses_do_not_hide_in_the_alignment(share: float, is_one_block: bool) -> None:
    truth = wandering_poses(50)
    rng = np.random.default_rng(1)
    bad = rng.choice(50, int(50 * share), replace=False)
    estimated = moved(truth, Pose.exp(np.array([30.0, 10, -5, 0.3, 0.1, 2.0])))
    for k in bad:
        offset = [80.0, -150, 60, 0.4, 0, 0.2] if is_one_block else rng.normal(0, [200, 200, 200, 0.5, 0.5, 0.5])
        estimated[k] = Pose.exp(np.array(offset)) @ estimated[k]
    result = compare_poses(estimated, truth)
    assert set(np.flatnonzero(result.is_wrong)) == set(bad)
    assert np.delete(result.error_mm, bad).max() < 1e-6


def test_either_limit_makes_a_pose_wrong() -> None:
    truth = wandering_poses(20)
    estimated = list(truth)
    estimated[3] = truth[3] @ Pose.exp(np.array([0, 3.1, 0, 0, 0, 0]))
    estimated[4] = truth[4] @ Pose.exp(np.array([0, 2.9, 0, 0, 0, 0]))
    estimated[5] = truth[5] @ Pose.exp(np.array([0, 0, 0, np.radians(0.51), 0, 0]))
    estimated[6] = truth[6] @ Pose.exp(np.array([0, 0, 0, np.radians(0.49), 0, 0]))
    result = compare_poses(estimated, truth)
    assert np.flatnonzero(result.is_wrong).tolist() == [3, 5]
    np.testing.assert_allclose(result.error_mm[3:5], [3.1, 2.9], atol=1e-6)
    np.testing.assert_allclose(result.error_deg[5:7], [0.51, 0.49], atol=1e-6)


@pytest.mark.parametrize("n", [1, 2])
def test_rotations_align_paths_too_short_for_positions_alone(n: int) -> None:
    truth = wandering_poses(n)
    result = compare_poses(moved(truth, Pose.exp(np.array([5.0, 6, 7, 0.1, 0.2, 0.3]))), truth)
    assert result.error_mm.max() < 1e-9
    assert result.error_deg.max() < 1e-9


def test_no_poses_have_no_errors() -> None:
    result = compare_poses([], [])
    assert len(result.error_mm) == 0
    assert np.isnan(result.ape_rmse_mm)


@pytest.mark.parametrize("is_map_given", [True, False])
def test_absolute_pose_error_is_evos(is_map_given: bool) -> None:
    truth = wandering_poses(60)
    rng = np.random.default_rng(2)
    noisy = [T @ Pose.exp(rng.normal(0, [1, 1, 1, 0.01, 0.01, 0.01])) for T in truth]
    estimated = moved(noisy, Pose.exp(np.array([3.0, 1, -5, 0.3, 0.1, 2.0])))

    def path(poses: list[Pose]) -> PosePath3D:
        return PosePath3D(poses_se3=[np.block([[T.R, T.t_mm[:, None]], [np.eye(4)[3:]]]) for T in poses])

    theirs_truth, theirs = path(truth), path(estimated)
    if not is_map_given:
        theirs.align(theirs_truth, correct_scale=False)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((theirs_truth, theirs))
    expected = ape.get_statistic(metrics.StatisticsType.rmse)
    assert expected > 1
    assert abs(compare_poses(estimated, truth, is_map_given=is_map_given).ape_rmse_mm - expected) < 1e-9


@pytest.mark.parametrize("is_map_given", [True, False])
def test_honest_covariances_are_consistent_and_boastful_or_timid_ones_are_not(is_map_given: bool) -> None:
    rng = np.random.default_rng(3)
    truth = wandering_poses(400)
    A = rng.normal(size=(6, 6)) * np.array([0.1, 0.1, 0.3, 1e-3, 1e-3, 1e-3])[:, None]
    C = A @ A.T
    estimated = [T @ Pose.exp(rng.multivariate_normal(np.zeros(6), C)).inverse() for T in truth]
    cov = np.tile(C, (400, 1, 1))
    if not is_map_given:  # the world is the sensor of the first pose
        estimated[0] = truth[0]
        estimated = moved(estimated, truth[0].inverse())
        cov[0] = 0.0
    nees = normalised_errors(estimated, truth, cov, is_map_given=is_map_given)
    assert np.isfinite(nees).sum() == (400 if is_map_given else 399)
    honest = consistency(nees)
    assert honest.poses == np.isfinite(nees).sum()
    assert honest.low < honest.mean < honest.high
    assert 0.9 < honest.low < 1 < honest.high < 1.1
    assert 0.92 < honest.inside.count / honest.inside.of < 0.98
    boastful, timid = consistency(4 * nees), consistency(nees / 4)
    assert boastful.mean > boastful.high
    assert timid.mean < timid.low
    assert max(boastful.inside.count, timid.inside.count) < 0.7 * honest.inside.of


def test_targets_are_aligned_with_the_majority_and_counted() -> None:
    rng = np.random.default_rng(4)
    true = dict(enumerate(rng.uniform(0, 300, (20, 3))))
    T = Pose.exp(np.array([3.0, 1, -5, 0.3, 0.1, 2.0]))
    identity = np.array([*range(15), 3, -1])
    xyz = T.apply(np.array([true[i] for i in [*range(15), 3, 0]]))
    xyz[15] += [10.0, 0, 0]  # a second target where the third one is
    result = compare_targets(xyz, identity, true)
    assert np.sort(result.error_mm)[:15].max() < 1e-9
    assert abs(result.error_mm[15] - 10) < 1e-9
    assert (result.found.count, result.found.of, result.duplicates, result.unknown) == (15, 20, 1, 1)
    assert compare_targets(xyz, identity, true, is_map_given=True).error_mm.min() > 1


def test_a_spread_is_median_root_mean_square_and_worst() -> None:
    assert Spread.of(np.array([0.0, 3.0, 4.0])) == Spread(3.0, np.sqrt(25 / 3), 4.0)
    assert np.isnan(Spread.of(np.zeros(0)).max)


# --- on folders ------------------------------------------------------------------------------------------------------

RIG = StereoRig(
    Camera(300.0, 300.0, 159.5, 119.5, 320, 240),
    Camera(300.0, 300.0, 159.5, 119.5, 320, 240),
    Pose(np.eye(3), np.array([-80.0, 0.0, 0.0])),
)


@dataclass
class Run:
    """A recording, its truth and its perfect result; spoil it, write it, evaluate it."""

    folder: Path
    is_map_given: bool = False
    n: int = 12
    truth: list[Pose] = field(default_factory=list)
    target_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    estimated: dict[int, Pose] = field(default_factory=dict)
    map_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    seen: list[np.ndarray] = field(default_factory=list)
    reasons: dict[int, str] = field(default_factory=dict)
    positionable: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    target_of_sighting: dict[tuple[int, int], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(5)
        self.truth = wandering_poses(self.n)
        self.target_mm = rng.uniform([-250, -150, -10], [900, 350, 10], (120, 3))
        T_world_map = Pose.identity() if self.is_map_given else self.truth[0].inverse()
        self.estimated = {k: T_world_map @ T for k, T in enumerate(self.truth)}
        self.map_mm = T_world_map.apply(self.target_mm)
        for T in self.truth:
            xyz = T.inverse().apply(self.target_mm)
            both = RIG.left.sees(xyz, 1.0) & RIG.right.sees(RIG.T_right_left.apply(xyz), 1.0)
            self.seen.append(rng.permutation(np.flatnonzero(both)))
        self.positionable = np.arange(self.n) >= 2

    @property
    def out(self) -> Path:
        return self.folder / "out"

    @property
    def truth_folder(self) -> Path:
        return self.folder / "truth"

    def in_sensor(self, k: int) -> np.ndarray:
        return self.truth[k].inverse().apply(self.target_mm[self.seen[k]])

    def refuse(self, k: int, reason: str) -> None:
        del self.estimated[k]
        self.reasons[k] = reason

    def write(self, level: str = "points") -> "Run":
        """Target i has the identity 1000 + i in the program's map."""
        self.out.mkdir(parents=True, exist_ok=True)
        self.truth_folder.mkdir(exist_ok=True)
        self._write_truth(level)
        self._write_recording(level)
        poses, tum, frames, sightings = [POSES_HEADER], [], ["frame,timestamp_ns,status,reason"], []
        cov = np.diag([SIGMA_MM**2] * 3 + [1e-8] * 3)
        row = 0
        for k in range(self.n):
            stamp = (k + 1) * 10**9
            is_first = k == 0 and not self.is_map_given
            if k in self.estimated:
                poses.append(poses_row(k, stamp, self.estimated[k], cov * (not is_first)))
                tum.append(tum_row(stamp, self.estimated[k]))
                frames.append(f"{k},{stamp},positioned,{'defines_world' if is_first else ''}")
            else:
                frames.append(f"{k},{stamp},refused,{self.reasons[k]}")
            for j, i in enumerate(self.seen[k]):
                target = self.target_of_sighting.get((k, j), 1000 + int(i))
                kinds = ["point"] if level == "points" else ["left", "right"]
                for side, kind in enumerate(kinds):
                    if k in self.estimated:
                        sightings.append(f"{k},{kind},{row + side * len(self.seen[k])},{target},0.0,")
                row += 1
            row += 0 if level == "points" else len(self.seen[k])
        (self.out / "poses.csv").write_text("\n".join(poses) + "\n")
        (self.out / "trajectory.tum").write_text("\n".join(tum) + "\n")
        (self.out / "frames.csv").write_text("\n".join(frames) + "\n")
        (self.out / "sightings.csv").write_text(
            "\n".join(["frame,kind,row,target,residual_mm,residual_px", *sightings])
        )
        (self.out / "summary.json").write_text(json.dumps({"level": level}))
        count = np.bincount(np.concatenate(self.seen), minlength=len(self.target_mm))
        kept = np.arange(len(count)) if self.is_map_given else np.flatnonzero(count)
        given = ReferenceMap.given(
            self.map_mm[kept],
            cov_mm2=np.tile(np.eye(3) * SIGMA_MM**2, (len(kept), 1, 1)),
            id=1000 + kept,
            sightings=count[kept],
        )
        write_map(given, self.out / "map.csv")
        return self

    def _write_truth(self, level: str) -> None:
        stamps = [(k + 1) * 10**9 for k in range(self.n)]
        rows = [tum_row(stamp, T) for stamp, T in zip(stamps, self.truth, strict=True)]
        (self.truth_folder / "trajectory.tum").write_text("\n".join(rows) + "\n")
        targets = ["id,x,y,z,nx,ny,nz,valid_from,valid_to,frames_seen_both"]
        targets += [
            f"{i},{x / 1e3:.9f},{y / 1e3:.9f},{z / 1e3:.9f},0,0,-1,0,{self.n},5"
            for i, (x, y, z) in enumerate(self.target_mm)
        ]
        (self.truth_folder / "map.csv").write_text("\n".join(targets) + "\n")
        header = (
            "frame,timestamp_ns,n_visible_cam0,n_visible_cam1,n_visible_both,n_known_both,positionable,"
            "reachable_online,reachable_offline,kidnapped,blank,sigma_pos_mm,sigma_rot_deg"
        )
        frames = [f"{k},{stamps[k]},9,9,9,9,{int(self.positionable[k])},1,1,0,0,," for k in range(self.n)]
        (self.truth_folder / "frames_truth.csv").write_text("\n".join([header, *frames]) + "\n")
        if level != "images":
            per_frame = [np.tile(seen, 1 if level == "points" else 2) for seen in self.seen]
            frame = np.repeat(np.arange(self.n), [len(ids) for ids in per_frame])
            labels = [f"{row},{k},{i}" for row, (k, i) in enumerate(zip(frame, np.concatenate(per_frame), strict=True))]
            (self.truth_folder / f"labels_{level}.csv").write_text("\n".join(["row,frame,id", *labels]) + "\n")

    def _write_recording(self, level: str) -> None:
        recording = self.folder / f"recording_{level}"
        recording.mkdir(exist_ok=True)
        stamps = (np.arange(self.n) + 1) * 10**9
        write_rig(RIG, recording / "calibration.yaml")
        if level == "points":
            write_frames(recording / "frames.csv", np.arange(self.n), stamps)
            k = np.repeat(np.arange(self.n), [len(seen) for seen in self.seen])
            xyz = np.vstack([self.in_sensor(i) for i in range(self.n)])
            cov = np.tile(np.diag([SIGMA_MM, SIGMA_MM, 3 * SIGMA_MM]) ** 2, (len(k), 1, 1))
            write_points(recording / "points.csv", k, stamps[k], xyz, cov_mm2=cov)
            return
        uv, k, camera = [], [], []
        for i in range(self.n):
            xyz = self.in_sensor(i)
            uv += [RIG.left.project(xyz), RIG.right.project(RIG.T_right_left.apply(xyz))]
            k += [i] * (2 * len(xyz))
            camera += [0] * len(xyz) + [1] * len(xyz)
        dots = recording if level == "dots" else self.out
        index = np.array(k)
        sigma_px = np.full(len(index), 0.05)
        write_dots(dots / "dots.csv", index, stamps[index], np.array(camera), np.vstack(uv), sigma_px=sigma_px)
        if level == "dots":
            write_frames(recording / "frames.csv", np.arange(self.n), stamps)
        else:
            for side in ("left", "right"):
                (recording / side).mkdir(exist_ok=True)
                for stamp in stamps:
                    cv2.imwrite(str(recording / side / f"{stamp:015d}.png"), np.zeros((240, 320), dtype=np.uint8))


@pytest.mark.parametrize("is_map_given", [True, False])
@pytest.mark.parametrize("level", ["points", "dots", "images"])
def test_a_perfect_result_has_no_errors(tmp_path: Path, level: str, is_map_given: bool) -> None:
    run = Run(tmp_path, is_map_given).write(level)
    e = evaluate(run.out, run.truth_folder)
    assert e.is_map_given == is_map_given
    assert (e.frames, e.positioned, e.refused) == (12, 12, {})
    assert (e.wrong, e.misidentified, e.drifted, e.unlabelled) == (0, (), 0, 0)
    assert e.error_mm.max < 1e-4
    assert e.error_deg.max < 1e-5
    assert e.ape_rmse_mm < 1e-4
    assert (e.of_positionable.count, e.of_positionable.of) == (10, 10)
    assert (e.of_sharing.count, e.of_sharing.of) == ((12, 12) if is_map_given else (11, 11))
    assert e.sightings.count == e.sightings.of > 100
    assert e.targets.count == (120 if is_map_given else len(set(np.concatenate(run.seen))))
    assert (e.targets.of, e.duplicates, e.unknown_targets) == (120, 0, 0)
    assert e.target_mm.max < 1e-4
    assert e.consistency.mean < 0.01  # too good to be true: there is no noise


def test_refused_frames_are_counted_by_reason_and_cost_their_share(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.refuse(1, "no_candidate")
    run.refuse(5, "ambiguous")
    run.refuse(6, "ambiguous")
    e = evaluate(run.write().out, run.truth_folder)
    assert e.refused == {"ambiguous": 2, "no_candidate": 1}
    assert (e.positioned, e.of_positionable.count, e.of_positionable.of) == (9, 8, 10)
    assert (e.of_reachable_online.count, e.of_reachable_online.of) == (9, 12)
    assert (e.of_sharing.count, e.of_sharing.of) == (8, 11)


@pytest.mark.parametrize("is_map_given", [True, False])
def test_a_wrong_pose_is_wrong_and_misidentified(tmp_path: Path, is_map_given: bool) -> None:
    run = Run(tmp_path, is_map_given)
    run.estimated[7] = run.estimated[7] @ Pose.exp(np.array([20.0, 0, 0, 0, 0, 0]))
    e = evaluate(run.write().out, run.truth_folder)
    assert (e.wrong, e.misidentified, e.drifted) == (1, (7,), 0)
    assert abs(e.error_mm.max - 20) < 1e-3
    assert e.drift_mm.max < 1e-3


def test_drift_is_not_misidentification(tmp_path: Path) -> None:
    run = Run(tmp_path)
    # the map bends away, and every pose is rightly found in the bent map
    run.map_mm = run.map_mm + np.outer((run.target_mm[:, 0] / 600) ** 2 * 20.0, [0.0, 0.0, 1.0])
    for k in range(1, run.n):
        run.estimated[k] = align(run.in_sensor(k), run.map_mm[run.seen[k]])
    e = evaluate(run.write().out, run.truth_folder)
    assert e.misidentified == ()
    assert e.wrong == e.drifted > 3
    assert e.drift_mm == e.error_mm
    assert e.sightings.count == e.sightings.of
    assert e.target_mm.max > 3


def test_a_pose_off_within_five_sigma_is_drift(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.seen[7] = run.seen[7][:3]
    run.write()
    labelled = {}
    for sigma_mm in (0.02, 20.0):
        cov = np.tile(np.eye(3) * sigma_mm**2, (sum(len(s) for s in run.seen), 1, 1))
        k = np.repeat(np.arange(run.n), [len(seen) for seen in run.seen])
        rng = np.random.default_rng(6)
        xyz = np.vstack([run.in_sensor(i) for i in range(run.n)]) + rng.normal(0, sigma_mm, (len(k), 3))
        write_points(tmp_path / "recording_points" / "points.csv", k, (k + 1) * 10**9, xyz, cov_mm2=cov)
        estimated = run.estimated[7] @ Pose.exp(np.array([6.0, 0, 0, 0, 0, 0]))
        spoilt = copy.copy(run)
        spoilt.estimated = run.estimated | {7: estimated}
        points = (tmp_path / "recording_points" / "points.csv").read_text()
        spoilt.write()
        (tmp_path / "recording_points" / "points.csv").write_text(points)
        labelled[sigma_mm] = evaluate(spoilt.out, spoilt.truth_folder)
    assert labelled[0.02].misidentified == (7,)
    assert labelled[20.0].misidentified == ()
    assert labelled[20.0].drifted == 1


def test_swapped_labels_are_seen(tmp_path: Path) -> None:
    run = Run(tmp_path)
    for k in (4, 8):
        first, second = 1000 + run.seen[k][:2]
        run.target_of_sighting |= {(k, 0): int(second), (k, 1): int(first)}
    e = evaluate(run.write().out, run.truth_folder)
    assert e.sightings.of == sum(len(seen) for seen in run.seen)
    assert e.sightings.count == e.sightings.of - 4


def test_a_given_map_taken_for_a_shifted_copy_of_itself_is_seen(tmp_path: Path) -> None:
    run = Run(tmp_path, is_map_given=True)
    columns, rows = np.meshgrid(np.arange(-10, 36), np.arange(-8, 15))
    grid = np.c_[columns.ravel() * 25.0, rows.ravel() * 25.0, np.zeros(columns.size)]
    run.target_mm = run.map_mm = grid
    run.seen = []
    for T in run.truth:
        xyz = T.inverse().apply(grid)
        run.seen.append(np.flatnonzero(RIG.left.sees(xyz, 1.0) & RIG.right.sees(RIG.T_right_left.apply(xyz), 1.0)))
    for k, T in enumerate(run.truth):
        run.estimated[k] = Pose(np.eye(3), np.array([25.0, 0, 0])) @ T
        run.target_of_sighting |= {(k, j): 1001 + int(i) for j, i in enumerate(run.seen[k])}
    e = evaluate(run.write().out, run.truth_folder)
    assert e.misidentified == tuple(range(12))
    assert e.sightings.count == 0


def test_without_labels_a_wrong_pose_counts_as_misidentified(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.estimated[7] = run.estimated[7] @ Pose.exp(np.array([20.0, 0, 0, 0, 0, 0]))
    run.write()
    (run.truth_folder / "labels_points.csv").unlink()
    e = evaluate(run.out, run.truth_folder)
    assert (e.unlabelled, e.wrong, e.misidentified, e.sightings.of) == (12, 1, (7,), 0)


def test_limits_of_the_recordings_own_can_be_given(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.estimated[7] = run.estimated[7] @ Pose.exp(np.array([8.0, 0, 0, 0, 0, 0]))
    run.write()
    assert evaluate(run.out, run.truth_folder, wrong_mm=10.0, wrong_deg=1.5).wrong == 0
    assert evaluate(run.out, run.truth_folder).wrong == 1


def test_a_target_the_map_has_in_a_wrong_place_does_not_move_the_pose_of_the_labels(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.map_mm[run.seen[6][0]] += [0.0, 40.0, 0.0]
    e = evaluate(run.write().out, run.truth_folder)
    assert e.misidentified == ()
    assert abs(e.target_mm.max - 40) < 1e-2


def test_a_run_without_any_pose_can_be_evaluated(tmp_path: Path) -> None:
    run = Run(tmp_path)
    for k in range(run.n):
        run.refuse(k, "too_few_points")
    e = evaluate(run.write().out, run.truth_folder)
    assert (e.positioned, e.wrong, e.of_positionable.count) == (0, 0, 0)
    plain = json.loads(json.dumps(e.to_dict(), allow_nan=False))
    assert plain["ape_rmse_mm"] is None
    assert plain["error_mm"] == {"median": None, "rmse": None, "max": None}
    assert ("positioned", "0 of 12 (0.0 %)") in table(e)


def test_the_table_gives_figures_with_units(tmp_path: Path) -> None:
    run = Run(tmp_path)
    run.refuse(5, "ambiguous")
    run.estimated[7] = run.estimated[7] @ Pose.exp(np.array([20.0, 0, 0, 0, 0, 0]))
    rows = dict(table(evaluate(run.write().out, run.truth_folder)))
    assert rows["frames"] == "12"
    assert rows["positioned"] == "11 of 12 (91.7 %)"
    assert rows["refused: ambiguous"] == "1"
    assert rows["wrong poses (beyond 3 mm or 0.5°)"] == "1"
    assert rows["misidentified"] == "1"
    assert rows["position error, median · rms · worst"].endswith("20.000 mm")


def test_results_of_another_recording_are_refused(tmp_path: Path) -> None:
    long, short = Run(tmp_path / "long", n=12), Run(tmp_path / "short", n=6)
    for run in (long, short):
        run.folder.mkdir()
        run.write()
    with pytest.raises(RecordingError, match="knows no frame 6 of the results; do they belong to the same recording"):
        evaluate(long.out, short.truth_folder)
    frames = short.truth_folder / "frames_truth.csv", short.truth_folder / "trajectory.tum"
    for file, old, new in zip(frames, ("\n5,6000000000", "\n6.000"), ("\n5,6000000001", "\n6.000000001"), strict=True):
        text = file.read_text()
        file.write_text(text.replace(old + "000000" * (file.suffix == ".tum"), new, 1))
    with pytest.raises(
        RecordingError, match=r"frames\.csv: frame 5 has time stamp 6000000000, in .*it has 6000000001;"
    ):
        evaluate(short.out, short.truth_folder)
    (long.out / "summary.json").unlink()
    with pytest.raises(RecordingError, match="results folder"):
        evaluate(long.out, long.truth_folder)


# --- what truth alone says can be had ---------------------------------------------------------------------------------


@dataclass
class Simulated:
    """A simulated recording of dots whose every frame is positioned rightly, but for those that are left out."""

    folder: Path
    n: int = 160
    is_map_given: bool = False

    def __post_init__(self) -> None:
        simulate("statue", self.folder, "dots", 3, self.n)
        self.simulation = simulate_frames("statue", 3, "dots", self.n)
        self.estimated = dict(enumerate(self.simulation.scene.T_map_sensor))

    def evaluate(self, is_online: bool = True) -> Evaluation:
        out, truth = self.folder / "out", self.simulation.truth
        out.mkdir(exist_ok=True)
        cov, stamps = np.diag([0.2**2] * 3 + [1e-6] * 3), truth.frames.timestamp_ns.tolist()
        poses = [POSES_HEADER] + [poses_row(k, stamps[k], T, cov) for k, T in self.estimated.items()]
        frames = [f"{k},{stamps[k]},{'positioned' if k in self.estimated else 'refused'}," for k in range(self.n)]
        sightings = []
        for k in self.estimated:
            dots = self.simulation.frames[k].content
            assert isinstance(dots, StereoDots)
            for kind, one in (("left", dots.left), ("right", dots.right)):
                sightings += [f"{k},{kind},{row},{truth.label[row]},," for row in one.row if truth.label[row] >= 0]
        for name, lines in {
            "poses.csv": poses,
            "frames.csv": ["frame,timestamp_ns,status,reason", *frames],
            "sightings.csv": ["frame,kind,row,target,residual_mm,residual_px", *sightings],
            "summary.json": [json.dumps({"level": "dots", "is_online": is_online})],
        }.items():
            (out / name).write_text("\n".join(lines) + "\n")
        targets = truth.targets
        cov_mm2 = np.tile(np.eye(3) * SIGMA_MM**2, (len(targets), 1, 1))
        write_map(ReferenceMap.given(targets.xyz_mm, cov_mm2, id=targets.id), out / "map.csv")
        return evaluate(out, self.folder / "truth", is_map_given=self.is_map_given)

    def shared(self) -> tuple[np.ndarray, np.ndarray]:
        """Per frame, what is seen by both cameras of the map that truth lets grow, and what by one of them."""
        truth = self.simulation.truth
        mapped = np.full(len(truth.targets), self.is_map_given)
        both, single = [], []
        for k, row in enumerate(truth.seen_both):
            both.append(row & mapped)
            single.append((truth.seen_left[k] ^ truth.seen_right[k]) & mapped)
            if truth.frames.reachable_online[k] and not self.is_map_given:
                mapped = mapped | row
        return np.array(both), np.array(single)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    return Simulated(tmp_path_factory.mktemp("simulated"))


@pytest.mark.parametrize("is_map_given", [False, True])
def test_what_a_frame_shares_with_the_true_map_is_counted_by_targets_and_equations(
    simulated: Simulated, is_map_given: bool
) -> None:
    run = copy.copy(simulated)
    run.is_map_given = is_map_given
    both, single = run.shared()
    few = (run.simulation.truth.seen_both.sum(axis=1) < 3) & (3 * both.sum(axis=1) + 2 * single.sum(axis=1) >= 7)
    assert few.sum() > 3
    e = run.evaluate()
    assert e.of_online4.count == e.of_online4.of == (both.sum(axis=1) >= 4).sum() > 50
    assert e.of_online3.count == e.of_online3.of == (both.sum(axis=1) == 3).sum() > 0
    assert e.of_few.count == e.of_few.of == few.sum()

    run.estimated = {k: T for k, T in run.estimated.items() if not few[k] and both[k].sum() < 6}
    e = run.evaluate()
    assert e.of_few.count == 0
    assert e.of_few.of == few.sum()
    assert e.of_online4.count == np.isin(both.sum(axis=1), [4, 5]).sum() < e.of_online4.of


def test_three_targets_count_soon_after_a_fix_alone(simulated: Simulated) -> None:
    run = copy.copy(simulated)
    both, _ = run.shared()
    three = np.flatnonzero(both.sum(axis=1) == 3).tolist()
    run.estimated = {k: T for k, T in run.estimated.items() if k not in three}
    soon = [k for k in three if any(j in run.estimated for j in range(k - 4, k))]  # 50 ms from frame to frame
    late = copy.copy(run)
    late.estimated = {k: T for k, T in run.estimated.items() if not any(k < j <= k + 4 for j in three)}
    assert soon
    assert (run.evaluate().of_online3.count, run.evaluate().of_online3.of) == (0, len(soon))
    assert late.evaluate().of_online3.of == 0


def test_poses_of_few_points_are_judged_by_their_single_dots(simulated: Simulated) -> None:
    run = copy.copy(simulated)
    truth = run.simulation.truth
    both, single = truth.seen_both.sum(axis=1), (truth.seen_left ^ truth.seen_right).sum(axis=1)
    few = np.flatnonzero((both < 3) & (3 * both + 2 * single >= 7)).tolist()
    unlabelled = int((3 * both + 2 * single < 7).sum())
    e = run.evaluate()
    assert (e.wrong, e.unlabelled) == (0, unlabelled)
    run.estimated = run.estimated | {few[0]: run.estimated[few[0]] @ Pose.exp(np.array([0, 15.0, 15.0, 0, 0, 0]))}
    e = run.evaluate()
    assert (e.wrong, e.misidentified, e.drifted, e.unlabelled) == (1, (few[0],), 0, unlabelled)


def test_single_dots_taken_for_another_target_are_wrong_sightings(simulated: Simulated) -> None:
    run = copy.copy(simulated)
    whole = run.evaluate()
    assert whole.sightings.count == whole.sightings.of
    truth = run.simulation.truth
    k = int(np.argmax((truth.seen_left ^ truth.seen_right).any(axis=1)))
    alone = int(np.argmax(truth.seen_left[k] ^ truth.seen_right[k]))
    file = run.folder / "out" / "sightings.csv"
    lines = file.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"{k},") and line.split(",")[3] == str(alone))
    lines[at] = ",".join([*lines[at].split(",")[:3], str((alone + 1) % len(truth.targets)), "", "0.1"])
    file.write_text("\n".join(lines) + "\n")
    e = evaluate(run.folder / "out", run.folder / "truth", is_map_given=False)
    assert (e.sightings.count, e.sightings.of) == (whole.sightings.count - 1, whole.sightings.of)


def test_the_table_shows_online_rates_for_online_runs_alone(simulated: Simulated) -> None:
    online, offline = (dict(table(simulated.evaluate(is_online))) for is_online in (True, False))
    only = {
        "positioned of those sharing four or more with the true map",
        "positioned of those sharing three, within 0.2 s of a fix",
    }
    assert set(online) - set(offline) == only
    assert "positioned of those with few points, but dots enough" in offline


# --- on real recordings ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["points", "dots"])
@pytest.mark.parametrize("name", ["chess_subset/seed_1", "dice_plate", "boofcv_dots"])
def test_real_truth_is_right_and_a_shift_of_it_is_misidentified(
    data: Path, tmp_path: Path, name: str, level: str
) -> None:
    truth = read_truth(data / name / "truth")
    results = {}
    for shift_mm in (0.0, 3.5):  # 3.5 mm: one cell of the dice plate
        out = tmp_path / f"{shift_mm}"
        out.mkdir()
        poses, frames = [POSES_HEADER], ["frame,timestamp_ns,status,reason"]
        for k, stamp, T in zip(
            truth.frames.index.tolist(), truth.frames.timestamp_ns.tolist(), truth.frames.T_map_sensor, strict=True
        ):
            poses.append(poses_row(k, stamp, Pose(np.eye(3), np.array([shift_mm, 0, 0])) @ T, np.eye(6) * 1e-6))
            frames.append(f"{k},{stamp},positioned,")
        (out / "poses.csv").write_text("\n".join(poses) + "\n")
        (out / "frames.csv").write_text("\n".join(frames) + "\n")
        (out / "sightings.csv").write_text("frame,kind,row,target\n")
        (out / "summary.json").write_text(json.dumps({"level": level}))
        (out / "map.csv").write_text((data / name / "map_given.csv").read_text())
        results[shift_mm] = evaluate(out, truth.path)
    right, shifted = results.values()
    assert right.is_map_given
    assert right.unlabelled == 0
    assert right.misidentified == ()
    assert right.error_mm.max < 1e-5
    assert right.targets.count == right.targets.of
    assert right.target_mm.max < 0.01
    assert right.of_sharing.of == right.frames
    assert len(shifted.misidentified) > 0.7 * shifted.frames
    assert abs(shifted.ape_rmse_mm - 3.5) < 1e-5
