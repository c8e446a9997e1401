"""Bundle adjustment against truth, against dense normal equations, and against two other programs."""

from dataclasses import replace

import numpy as np
import pytest

from constellations import LEFT, RIG, chi2_limits, looking, nees, scattered, sensor_covariances
from trifix.adjustment import (
    Adjustment,
    AdjustOptions,
    ControlTargets,
    DotObservations,
    PointObservations,
    RigSigmas,
    ScaleBar,
    adjust,
    intrinsics_jacobian,
)
from trifix.errors import AdjustmentError
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose

SIGMA_PX = 0.1
WIDE = Camera(600.0, 610.0, 640.0, 500.0, 1280, 1024, "equidistant", (0.02, -0.01, 0.003, -0.001))
WIDE_RIG = StereoRig(WIDE, replace(WIDE, fu_px=615.0), RIG.T_right_left)
PLAIN = Camera(1400.0, 1401.0, 646.0, 507.0, 1280, 1024)
PLAIN_RIG = StereoRig(PLAIN, replace(PLAIN, pu_px=634.0), RIG.T_right_left)


# --- scenes ----------------------------------------------------------------------------------------------------------


def scene(rng, frames=12, targets=16):
    """Poses and targets in the first frame's coordinates."""
    xyz = scattered(rng, targets)
    poses = [looking(rng) for _ in range(frames)]
    to_first = poses[0].inverse()
    return [to_first @ T for T in poses], to_first.apply(xyz)


def dots(rng, poses, xyz, rig=RIG, share=0.8, sigma_px=SIGMA_PX):
    """Dots of both images, some missing; every dot with an error ellipse of its own."""
    parts = []
    for k, T in enumerate(poses):
        in_left = T.inverse().apply(xyz)
        for camera, lens, place in ((0, rig.left, in_left), (1, rig.right, rig.T_right_left.apply(in_left))):
            rows = np.flatnonzero(lens.sees(place) & (rng.random(len(xyz)) < share))
            parts.append((np.full(len(rows), k), rows, np.full(len(rows), camera), lens.project(place[rows])))
    frame, target, camera, uv = (np.concatenate(column) for column in zip(*parts, strict=True))
    shape = rng.normal(size=(len(uv), 2, 2)) * 0.3 + np.eye(2)
    cov = sigma_px**2 * shape @ np.swapaxes(shape, 1, 2)
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=uv.shape))
    return DotObservations(frame, target, camera, uv + noise, cov)


def points(rng, poses, xyz, share=0.8):
    parts = []
    for k, T in enumerate(poses):
        rows = np.flatnonzero(rng.random(len(xyz)) < share)
        place = T.inverse().apply(xyz[rows])
        cov = sensor_covariances(place)
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(cov), rng.normal(size=place.shape))
        parts.append((np.full(len(rows), k), rows, place + noise, cov))
    return PointObservations(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def some(observations, rows):
    return type(observations)(*(getattr(observations, name)[rows] for name in observations.__slots__))


def shaken(rng, poses, xyz, mm=2.0, rad=0.01):
    """A start that is off; the first pose is left alone."""
    off = [Pose.exp(rng.normal(size=6) * ([mm] * 3 + [rad] * 3)) for _ in poses]
    return [poses[0], *(T @ d for T, d in zip(poses[1:], off[1:], strict=True))], xyz + mm * rng.normal(size=xyz.shape)


def misfit(out: Adjustment, poses, xyz):
    """Normalised squared errors of the free poses (each / 6) and of the whole map (/ 3n)."""
    of_pose = [nees(out.T_world_sensor[k], out.pose_cov[k], poses[k]) / 6 for k in range(1, len(poses))]
    off = (xyz - out.xyz_mm).ravel()
    return np.array(of_pose), float(off @ np.linalg.solve(out.map_cov_mm2, off)) / len(off)


# --- against truth ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["dots", "points"])
def test_normalised_errors_follow_their_covariance(level):
    of_pose, of_map, ratio, chi2 = [], [], [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        poses, xyz = scene(rng)
        seen = dots(rng, poses, xyz) if level == "dots" else points(rng, poses, xyz)
        out = adjust(seen, *shaken(rng, poses, xyz), rig=RIG if level == "dots" else None)
        pose, map = misfit(out, poses, xyz)
        of_pose.append(pose.mean())
        of_map.append(map)
        ratio.append(((out.xyz_mm - xyz) ** 2).sum() / np.trace(out.map_cov_mm2))
        chi2.append(out.chi2 / out.dof)
    low, high = chi2_limits(30 * 48)
    assert low < 30 * 48 * np.mean(of_map) < high
    # poses of one run share the error of the first frame: fewer freedoms than they have coordinates
    assert 0.85 < np.mean(of_pose) < 1.15
    assert 0.8 < np.sqrt(np.mean(ratio)) < 1.15
    assert 0.97 < np.mean(chi2) < 1.03


def test_the_scatter_of_repeated_measurements_is_what_was_predicted():
    rng = np.random.default_rng(5)
    poses, xyz = scene(rng, frames=8, targets=10)
    off_pose, off_map = [], []
    for _ in range(100):
        seen = dots(np.random.default_rng(1), poses, xyz, sigma_px=1e-9)  # always the same dots
        cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(seen), 1, 1))
        seen = replace(seen, uv_px=seen.uv_px + SIGMA_PX * rng.normal(size=seen.uv_px.shape), cov_px2=cov)
        out = adjust(seen, poses, xyz, rig=RIG)
        off_pose.append((out.T_world_sensor[5].inverse() @ poses[5]).log())
        off_map.append((out.xyz_mm - xyz).ravel())
    for sampled, predicted in (
        (np.cov(np.array(off_pose).T), out.pose_cov[5]),
        (np.cov(np.array(off_map).T), out.map_cov_mm2),
    ):
        L = np.linalg.inv(np.linalg.cholesky(predicted))
        white = np.trace(L @ sampled @ L.T) / len(L)
        assert 0.85 < white < 1.15
        assert 0.8 < np.sqrt(np.trace(sampled) / np.trace(predicted)) < 1.2


def test_the_start_does_not_matter():
    rng = np.random.default_rng(2)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    near = adjust(seen, poses, xyz, rig=RIG)
    far = adjust(seen, *shaken(rng, poses, xyz, mm=20.0, rad=0.05), rig=RIG)
    assert np.abs(near.xyz_mm - far.xyz_mm).max() < 1e-8
    for a, b in zip(near.T_world_sensor, far.T_world_sensor, strict=True):
        assert np.abs((a.inverse() @ b).log()).max() < 1e-8
    assert np.allclose(near.pose_cov, far.pose_cov, rtol=1e-6, atol=1e-14)


def test_the_order_of_the_observations_does_not_matter():
    rng = np.random.default_rng(3)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    shuffle = rng.permutation(len(seen))
    one, other = (adjust(each, poses, xyz, rig=RIG) for each in (seen, some(seen, shuffle)))
    assert np.abs(one.xyz_mm - other.xyz_mm).max() < 1e-9
    assert np.abs(one.weight[shuffle] - other.weight).max() < 1e-6


def test_misidentified_dots_do_not_matter():
    rng = np.random.default_rng(4)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    wrong = rng.choice(len(seen), len(seen) // 20, replace=False)
    target = seen.target.copy()
    target[wrong] = (target[wrong] + rng.integers(1, len(xyz), len(wrong))) % len(xyz)
    out = adjust(replace(seen, target=target), *shaken(rng, poses, xyz), rig=RIG)
    clean = adjust(some(seen, np.setdiff1d(np.arange(len(seen)), wrong)), poses, xyz, rig=RIG)
    assert (out.weight[wrong] == 0).all()
    assert np.abs(out.xyz_mm - clean.xyz_mm).max() < 1e-8
    assert 0.9 < out.chi2 / out.dof < 1.1


def test_a_frame_whose_targets_are_all_mistaken_is_left_out_and_does_no_harm():
    rng = np.random.default_rng(0)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    mistaken = seen.frame == 5
    target = np.where(mistaken, (seen.target + 1) % len(xyz), seen.target)
    T, X = shaken(rng, poses, xyz)
    out = adjust(replace(seen, target=target), T, X, rig=RIG)
    assert np.flatnonzero(~out.is_frame_adjusted).tolist() == [5]
    assert out.T_world_sensor[5] is T[5]
    clean = adjust(some(seen, np.flatnonzero(~mistaken)), poses, xyz, rig=RIG)
    assert np.abs(out.xyz_mm - clean.xyz_mm).max() < 0.005


def test_a_target_that_moved_half_way_is_left_out_or_placed_where_it_was():
    rng = np.random.default_rng(0)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    moved = (seen.target == 3) & (seen.frame >= 6)
    T, X = shaken(rng, poses, xyz)
    out = adjust(replace(seen, uv_px=seen.uv_px + 12.0 * moved[:, None]), T, X, rig=RIG)
    assert out.is_target_adjusted[3] == (out.weight[seen.target == 3] > 0).any()
    assert out.is_target_adjusted[3] or (out.xyz_mm[3] == X[3]).all()
    assert np.delete(out.is_target_adjusted, 3).all()
    assert 0.85 < out.chi2 / out.dof < 1.15


def test_targets_seen_by_one_camera_only_are_placed_and_help():
    rng = np.random.default_rng(6)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    keep = np.flatnonzero((seen.camera == 0) | (seen.target >= 4))
    out = adjust(some(seen, keep), *shaken(rng, poses, xyz), rig=RIG)
    assert out.is_target_adjusted.all()
    off = out.xyz_mm[:4] - xyz[:4]
    sigma = np.sqrt(np.trace(out.target_cov_mm2[:4], axis1=1, axis2=2))
    assert (np.linalg.norm(off, axis=1) < 3 * sigma).all()
    assert sigma.max() < 0.3
    without = adjust(some(seen, np.flatnonzero(seen.target >= 4)), poses, xyz, rig=RIG)
    assert (np.trace(out.pose_cov[1:], axis1=1, axis2=2) < np.trace(without.pose_cov[1:], axis1=1, axis2=2)).all()


def test_each_frame_may_have_a_rig_of_its_own():
    rng = np.random.default_rng(7)
    poses, xyz = scene(rng, frames=6)
    rigs = [
        RIG if k % 2 else replace(RIG, T_right_left=RIG.T_right_left @ Pose.exp(np.full(6, 0.01))) for k in range(6)
    ]
    parts = [dots(rng, [T], xyz, rig) for T, rig in zip(poses, rigs, strict=True)]
    columns = [np.concatenate([getattr(part, name) for part in parts]) for name in DotObservations.__slots__]
    columns[0] = np.repeat(np.arange(6), [len(part) for part in parts])
    seen = DotObservations(*columns)
    out = adjust(seen, *shaken(rng, poses, xyz), rig=rigs)
    assert 0.85 < out.chi2 / out.dof < 1.15
    with pytest.raises(AdjustmentError, match="2 rigs were given for 6 frames"):
        adjust(seen, poses, xyz, rig=rigs[:2])


# --- against dense normal equations ----------------------------------------------------------------------------------


def stepped_rig(rig, step):
    """The rig after a step of T_right_left · exp(δ) and of both cameras' intrinsics."""
    lenses, at = [], 6
    for lens in (rig.left, rig.right):
        d = step[at : at + 4 + len(lens.coefficients)]
        at += len(d)
        lenses.append(
            replace(
                lens,
                fu_px=lens.fu_px + d[0],
                fv_px=lens.fv_px + d[1],
                pu_px=lens.pu_px + d[2],
                pv_px=lens.pv_px + d[3],
                coefficients=tuple(c + e for c, e in zip(lens.coefficients, d[4:], strict=True)),
            )
        )
    return StereoRig(*lenses, rig.T_right_left @ Pose.exp(step[:6]))


def whitened(seen, poses, xyz, rig):
    """Residuals over their standard deviations, written down as one would on paper."""
    out = []
    for m in range(len(seen)):
        place = poses[seen.frame[m]].inverse().apply(xyz[seen.target[m]][None])
        if isinstance(seen, PointObservations):
            off, cov = seen.xyz_mm[m] - place[0], seen.cov_mm2[m]
        else:
            left = seen.camera[m] == 0
            uv = rig.left.project(place) if left else rig.right.project(rig.T_right_left.apply(place))
            off, cov = seen.uv_px[m] - uv[0], seen.cov_px2[m]
        out.append(np.linalg.solve(np.linalg.cholesky(cov), off))
    return np.concatenate(out)


@pytest.mark.parametrize(
    ("rig", "refine"), [(RIG, None), (WIDE_RIG, None), (None, None), (RIG, RigSigmas()), (WIDE_RIG, RigSigmas())]
)
def test_result_is_stationary_and_its_covariance_that_of_the_dense_equations(rig, refine):
    """Every Jacobian at once, and the elimination of the poses, against central differences."""
    rng = np.random.default_rng(11)
    poses, xyz = scene(rng, frames=5, targets=8)
    seen = points(rng, poses, xyz) if rig is None else dots(rng, poses, xyz, rig, sigma_px=0.1)
    bar = ScaleBar(1, 6, float(np.linalg.norm(xyz[1] - xyz[6])) + 0.02, 0.05)
    everything = AdjustOptions(doubt_sigmas=8.0, reject_sigmas=20.0)  # all weights one: the plain least squares
    out = adjust(seen, *shaken(rng, poses, xyz), rig=rig, scale_bars=[bar], refine_rig=refine, options=everything)
    assert (out.weight == 1).all()
    q = len(out.rig_parameters)

    def residuals(step):
        T = [out.T_world_sensor[0]]
        T += [one @ Pose.exp(d) for one, d in zip(out.T_world_sensor[1:], step[:24].reshape(4, 6), strict=True)]
        X = out.xyz_mm + step[24:48].reshape(8, 3)
        length = np.linalg.norm(X[bar.first] - X[bar.second])
        known = [[(length - bar.length_mm) / bar.sigma_mm]]
        now = rig
        if refine is not None:
            now = stepped_rig(out.rig, step[48:])
            sigma = [2.0] * 3 + [0.01] * 3 + ([20.0] * 4 + [0.1] * 4) * 2
            lenses = [[L.fu_px, L.fv_px, L.pu_px, L.pv_px, *L.coefficients] for L in (now.left, now.right)]
            given = [[L.fu_px, L.fv_px, L.pu_px, L.pv_px, *L.coefficients] for L in (rig.left, rig.right)]
            moved = (rig.T_right_left.inverse() @ now.T_right_left).log()
            known.append(np.concatenate([moved, np.ravel(lenses) - np.ravel(given)]) / sigma)
        return np.concatenate([whitened(seen, T, X, now), *known])

    h = 1e-4 if refine is None else 1e-5
    J = np.stack([(residuals(e) - residuals(-e)) / (2 * h) for e in h * np.eye(48 + q)], axis=1)
    cov = np.linalg.inv(J.T @ J)
    step = cov @ (J.T @ residuals(np.zeros(48 + q)))  # what is left to go
    assert np.abs(step / np.sqrt(np.diag(cov))).max() < 1e-4
    for found, rows in [
        (out.map_cov_mm2, slice(24, 48)),
        (out.rig_cov, slice(48, None)),
        *((out.pose_cov[k], slice(6 * k - 6, 6 * k)) for k in range(1, 5)),
    ]:
        scale = np.sqrt(np.diag(cov[rows, rows]))
        assert np.abs((found - cov[rows, rows]) / np.outer(scale, scale)).max(initial=0.0) < 1e-4
    assert (out.pose_cov[0] == 0).all()
    assert out.chi2 == pytest.approx((residuals(np.zeros(48 + q)) ** 2).sum(), rel=1e-9)
    assert out.dof == len(residuals(np.zeros(48 + q))) - 48 - q


@pytest.mark.parametrize("lens", [LEFT, replace(LEFT, coefficients=(-0.08, 0.04, 4e-4, -3e-4, 0.02)), WIDE, PLAIN])
def test_intrinsics_jacobian_is_the_central_difference(lens):
    rng = np.random.default_rng(12)
    xyz = np.c_[rng.uniform(-150, 150, (20, 2)), rng.uniform(400, 600, 20)]
    J = intrinsics_jacobian(lens, xyz)
    names = ("fu_px", "fv_px", "pu_px", "pv_px")
    ways = [lambda d, name=name: replace(lens, **{name: getattr(lens, name) + d}) for name in names]
    for i in range(len(lens.coefficients)):
        one = np.eye(len(lens.coefficients))[i]
        ways.append(lambda d, one=one: replace(lens, coefficients=tuple(np.array(lens.coefficients) + d * one)))
    for i, way in enumerate(ways):
        assert np.abs((way(1e-4).project(xyz) - way(-1e-4).project(xyz)) / 2e-4 - J[:, :, i]).max() < 1e-6


# --- the rig ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("knows_scale", [True, False])
def test_a_rig_that_is_off_is_found_again(knows_scale):
    sigmas = RigSigmas(rotation_rad=2e-3, translation_mm=0.5, focal_px=3.0, principal_px=3.0, distortion=0.005)
    first = 6 if knows_scale else 5
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        poses, xyz = scene(rng, frames=15, targets=16)
        sigma = np.array([0.5] * 3 + [2e-3] * 3 + ([3.0] * 4 + [0.005] * 4) * 2)
        given = stepped_rig(RIG, sigma * rng.normal(size=len(sigma)))
        if not knows_scale:
            T = given.T_right_left
            given = replace(given, T_right_left=Pose(T.R, T.t_mm * (RIG.baseline_mm / given.baseline_mm)))
        seen = dots(rng, poses, xyz)
        bars = [ScaleBar(0, 1, float(np.linalg.norm(xyz[0] - xyz[1])), 0.01)] if knows_scale else []
        out = adjust(seen, *shaken(rng, poses, xyz), rig=given, scale_bars=bars, refine_rig=sigmas)
        assert len(out.rig_parameters) == first + 16
        if not knows_scale:
            assert abs(out.rig.baseline_mm - RIG.baseline_mm) < 1e-9
        off = (xyz - out.xyz_mm).ravel()
        off_rig = [L.fu_px - M.fu_px for L, M in ((RIG.left, out.rig.left), (RIG.right, out.rig.right))]
        sigma_rig = np.sqrt(np.diag(out.rig_cov))[[first, first + 8]]
        found.append([off @ np.linalg.solve(out.map_cov_mm2, off) / len(off), *(off_rig / sigma_rig) ** 2])
        fixed = adjust(seen, poses, xyz, rig=given, scale_bars=bars)
        assert fixed.chi2 / fixed.dof > 1.1  # the given rig does not fit
        assert 0.85 < out.chi2 / out.dof < 1.15
    low, high = chi2_limits(12 * 48)
    assert low < 12 * 48 * np.mean(found, axis=0)[0] < high
    low, high = chi2_limits(24)
    assert low < np.sum(found, axis=0)[1:].sum() < high


# --- gauges ----------------------------------------------------------------------------------------------------------


def test_targets_known_beforehand_are_the_world():
    of_map = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        poses, xyz = scene(rng)
        cov = np.tile(np.diag([0.02, 0.03, 0.05]) ** 2, (6, 1, 1))
        known = xyz[:6] + rng.normal(size=(6, 3)) * [0.02, 0.03, 0.05]
        T, X = shaken(rng, poses, xyz)
        T[0] = T[0] @ Pose.exp(np.full(6, 0.01))  # the first pose is as free as the others
        out = adjust(dots(rng, poses, xyz), T, X, rig=RIG, gauge=ControlTargets(np.arange(6), known, cov))
        off = (xyz - out.xyz_mm).ravel()
        of_map.append(off @ np.linalg.solve(out.map_cov_mm2, off))
        assert nees(out.T_world_sensor[0], out.pose_cov[0], poses[0]) < 25
    low, high = chi2_limits(20 * 48)
    assert low < np.sum(of_map) < high


def test_targets_known_far_better_than_they_are_seen_settle_too():
    rng = np.random.default_rng(18)
    poses, xyz = scene(rng)
    gauge = ControlTargets(np.arange(6), xyz[:6], np.tile(1e-16 * np.eye(3), (6, 1, 1)))
    out = adjust(dots(rng, poses, xyz), *shaken(rng, poses, xyz), rig=RIG, gauge=gauge)
    assert np.abs(out.xyz_mm[:6] - xyz[:6]).max() < 1e-7
    assert out.steps < 15


def test_a_map_known_exactly_stays_and_places_every_frame_by_itself():
    rng = np.random.default_rng(8)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    gauge = ControlTargets(np.arange(len(xyz)), xyz, np.zeros((len(xyz), 3, 3)))
    T, X = shaken(rng, poses, xyz)
    out = adjust(seen, T, X, rig=RIG, gauge=gauge)
    assert (out.xyz_mm == xyz).all()
    assert (out.map_cov_mm2 == 0).all()
    rows = np.flatnonzero(seen.frame == 4)
    alone = adjust(replace(some(seen, rows), frame=np.zeros(len(rows), int)), [T[4]], X, rig=RIG, gauge=gauge)
    assert np.abs((alone.T_world_sensor[0].inverse() @ out.T_world_sensor[4]).log()).max() < 1e-9
    assert np.allclose(alone.pose_cov[0], out.pose_cov[4], rtol=1e-6, atol=0)
    normalised = [nees(out.T_world_sensor[k], out.pose_cov[k], poses[k]) for k in range(len(poses))]
    low, high = chi2_limits(6 * len(poses))
    assert low < np.sum(normalised) < high


def test_a_scale_bar_sets_the_scale():
    rng = np.random.default_rng(9)
    poses, xyz = scene(rng)
    bar = ScaleBar(0, 1, 1.001 * float(np.linalg.norm(xyz[0] - xyz[1])), 1e-6)
    wide = RigSigmas(rotation_rad=1e-5, translation_mm=50.0, focal_px=0.01, principal_px=0.01, distortion=1e-6)
    out = adjust(dots(rng, poses, xyz), poses, xyz, rig=RIG, scale_bars=[bar], refine_rig=wide)
    assert abs(np.linalg.norm(out.xyz_mm[0] - out.xyz_mm[1]) - bar.length_mm) < 1e-5
    assert 1.0005 < out.rig.baseline_mm / RIG.baseline_mm < 1.0015


# --- too little, too much, and nonsense ------------------------------------------------------------------------------


def test_what_was_seen_too_little_is_left_as_it_was():
    rng = np.random.default_rng(10)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    # target 3 in one image only; frame 5 with two targets only
    once = np.flatnonzero(seen.target == 3)[:1]
    keep = np.flatnonzero((seen.target != 3) & ((seen.frame != 5) | (seen.target < 2)))
    seen = some(seen, np.concatenate([once, keep]))
    T, X = shaken(rng, poses, xyz)
    out = adjust(seen, T, X, rig=RIG)
    assert np.flatnonzero(~out.is_target_adjusted).tolist() == [3]
    assert np.flatnonzero(~out.is_frame_adjusted).tolist() == [5]
    assert (out.xyz_mm[3] == X[3]).all()
    assert out.T_world_sensor[5] is T[5]
    assert np.isnan(out.target_cov_mm2[3]).all()
    assert np.isnan(out.pose_cov[5]).all()
    assert np.isfinite(np.delete(out.pose_cov, 5, axis=0)).all()
    assert (out.weight[seen.frame == 5] == 0).all()
    assert out.weight[0] == 0


def test_frames_that_nothing_ties_to_the_world_are_refused():
    rng = np.random.default_rng(13)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    apart = some(seen, np.flatnonzero((seen.frame < 6) == (seen.target < 8)))
    with pytest.raises(AdjustmentError, match=r"Target (8|9|1\d) is not tied to frame 0: "):
        adjust(apart, poses, xyz, rig=RIG)
    two = ControlTargets(np.arange(2), xyz[:2], np.tile(1e-4 * np.eye(3), (2, 1, 1)))
    with pytest.raises(AdjustmentError, match="not tied to the known targets"):
        adjust(seen, poses, xyz, rig=RIG, gauge=two)


def test_nonsense_is_refused_in_a_sentence():
    rng = np.random.default_rng(14)
    poses, xyz = scene(rng, frames=3)
    seen = dots(rng, poses, xyz)
    none = some(seen, np.arange(0))
    broken, flat = seen.uv_px.copy(), seen.cov_px2.copy()
    broken[7], flat[9] = np.nan, 0.0
    many = np.zeros((3001, 3))
    away = [T @ Pose.exp(np.array([0, 0, 0, np.pi, 0, 0])) for T in poses]
    twice = ControlTargets(np.array([1, 1]), xyz[:2], np.zeros((2, 3, 3)))
    for match, wrong in [
        ("no observation was given", lambda: adjust(none, poses, xyz, rig=RIG)),
        ("3001 targets are too many", lambda: adjust(seen, poses, many, rig=RIG)),
        ("none was given", lambda: adjust(seen, poses, xyz)),
        ("no frame 2", lambda: adjust(seen, poses[:2], xyz, rig=RIG)),
        ("no target 15", lambda: adjust(seen, poses, xyz[:15], rig=RIG)),
        ("no gauge's frame 3", lambda: adjust(seen, poses, xyz, rig=RIG, gauge=3)),
        ("Observation 7 holds", lambda: adjust(replace(seen, uv_px=broken), poses, xyz, rig=RIG)),
        ("observation 9 is not positive", lambda: adjust(replace(seen, cov_px2=flat), poses, xyz, rig=RIG)),
        ("two different targets", lambda: adjust(seen, poses, xyz, rig=RIG, scale_bars=[ScaleBar(1, 1, 5.0, 0.1)])),
        ("in front of the camera", lambda: adjust(seen, away, xyz, rig=RIG)),
        ("known twice", lambda: adjust(seen, poses, xyz, rig=RIG, gauge=twice)),
        ("can be refined", lambda: adjust(points(rng, poses, xyz), poses, xyz, refine_rig=RigSigmas())),
    ]:
        with pytest.raises(AdjustmentError, match=match):
            wrong()


# --- against two other programs --------------------------------------------------------------------------------------


def plain_least_squares(seed):
    """A scene with circular noise, and its adjustment with all weights one."""
    rng = np.random.default_rng(seed)
    poses, xyz = scene(rng)
    seen = dots(rng, poses, xyz)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(seen), 1, 1))
    seen = replace(seen, cov_px2=cov)
    T, X = shaken(rng, poses, xyz)
    everything = AdjustOptions(doubt_sigmas=30.0, reject_sigmas=90.0)
    return seen, T, X, adjust(seen, T, X, rig=RIG, options=everything)


def test_gtsam_finds_the_same_minimum_and_covariances():
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed (extra: crosscheck)")
    seen, T, X, out = plain_least_squares(21)
    pose3 = lambda T: gtsam.Pose3(gtsam.Rot3(T.R), T.t_mm)  # noqa: E731
    lenses = [gtsam.Cal3DS2(L.fu_px, L.fv_px, 0.0, L.pu_px, L.pv_px, *L.coefficients) for L in (RIG.left, RIG.right)]
    mounts = [gtsam.Pose3(), pose3(RIG.T_right_left.inverse())]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose_key, point_key = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    for m in range(len(seen)):
        noise = gtsam.noiseModel.Gaussian.Covariance(seen.cov_px2[m])
        keys = pose_key(int(seen.frame[m])), point_key(int(seen.target[m]))
        lens, mount = lenses[seen.camera[m]], mounts[seen.camera[m]]
        graph.add(gtsam.GenericProjectionFactorCal3DS2(seen.uv_px[m], noise, *keys, lens, mount))
    graph.add(gtsam.NonlinearEqualityPose3(pose_key(0), pose3(T[0])))
    for k, one in enumerate(T):
        values.insert(pose_key(k), pose3(one))
    for j, place in enumerate(X):
        values.insert(point_key(j), place)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(1e-14)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, found)
    assert 2 * graph.error(found) == pytest.approx(out.chi2, rel=1e-9)
    for j in range(len(X)):
        assert np.abs(found.atPoint3(point_key(j)) - out.xyz_mm[j]).max() < 1e-6
        assert np.allclose(marginals.marginalCovariance(point_key(j)), out.target_cov_mm2[j], rtol=1e-4, atol=1e-8)
    order = [3, 4, 5, 0, 1, 2]  # theirs has the rotation first
    for k in range(1, len(T)):
        other = found.atPose3(pose_key(k))
        off = (out.T_world_sensor[k].inverse() @ Pose(other.rotation().matrix(), other.translation())).log()
        assert np.abs(off).max() < 1e-6
        cov = marginals.marginalCovariance(pose_key(k))[np.ix_(order, order)]
        scale = np.sqrt(np.diag(cov))
        assert np.abs((cov - out.pose_cov[k]) / np.outer(scale, scale)).max() < 1e-4


def test_pycolmap_finds_the_same_minimum():
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed (extra: crosscheck)")
    seen, T, X, out = plain_least_squares(22)
    rigid = lambda T: pycolmap.Rigid3d(pycolmap.Rotation3d(T.R), T.t_mm)  # noqa: E731
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for i, lens in enumerate((RIG.left, RIG.right)):
        values = [lens.fu_px, lens.fv_px, lens.pu_px, lens.pv_px, *lens.coefficients]
        size = {"width": lens.width_px, "height": lens.height_px}
        camera = pycolmap.Camera(model="OPENCV", params=values, camera_id=i + 1, **size)
        model.add_camera(camera)
        if i == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, rigid(RIG.T_right_left))
    model.add_rig(rig)
    targets = [model.add_point3D(place, pycolmap.Track(), np.zeros(3, np.uint8)) for place in X]
    config = pycolmap.BundleAdjustmentConfig()
    for k, one in enumerate(T):
        frame = pycolmap.Frame(frame_id=k + 1, rig_id=1, rig_from_world=rigid(one.inverse()))
        images = []
        for i in range(2):
            rows = np.flatnonzero((seen.frame == k) & (seen.camera == i))
            image = pycolmap.Image(f"{k}/{i}", keypoints=seen.uv_px[rows], camera_id=i + 1, image_id=2 * k + i + 1)
            image.frame_id = k + 1
            frame.add_data_id(image.data_id)
            images.append((image, rows))
        model.add_frame(frame)
        for image, rows in images:
            model.add_image(image)
            for row, m in enumerate(rows):
                model.add_observation(targets[seen.target[m]], pycolmap.TrackElement(image.image_id, row))
            config.add_image(image.image_id)
        model.register_frame(k + 1)
    config.set_constant_rig_from_world_pose(1)
    config.set_constant_sensor_from_rig_pose(model.camera(2).sensor_id)
    for i in (1, 2):
        config.set_constant_cam_intrinsics(i)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 1e-16
    solver.max_num_iterations = 200
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    found = np.array([model.point3D(target).xyz for target in targets])
    assert np.abs(found - out.xyz_mm).max() < 1e-5
    for k in range(len(T)):
        other = model.frame(k + 1).rig_from_world
        pose = Pose(other.rotation.matrix(), other.translation).inverse()
        assert np.abs((out.T_world_sensor[k].inverse() @ pose).log()).max() < 1e-5
