"""Calibrate a stereo rig from sightings of a board, whose points are about where they are meant to be.

OpenCV finds each camera (Zhang 2000) and how they stand to one another; then one least squares over both cameras, their
relative pose and all poses of the board uses every point, also those that one camera alone has seen, and tells how
uncertain the result is. Where there are views enough, the places of the board's points are sought as well. Knows no
image: who found the points, and on what board, is not its concern.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from trifix.errors import CalibrationError
from trifix.geometry.camera import Camera, StereoRig, distort
from trifix.geometry.epipolar import essential_matrix
from trifix.geometry.pose import Pose

LEAST_VIEWS = 3
"""Fewer poses of a flat board do not determine a camera (Zhang 2000, section 3.1)."""
LEAST_POINTS = 6
"""Fewer points of a board in one image say too little."""
ENOUGH_VIEWS = 5
"""In fewer views the board's points are held where they are meant to be."""
OUTLIER = 3.0
"""A view is left out when its rms residual exceeds that of half of the views by this factor."""

_WORST_FOCAL = 0.02  # standard deviation of a focal length, relative, at which it counts as undetermined
_CAMERA = 8  # parameters of a camera; six of the pose follow those of both
_RIG = 2 * _CAMERA + 6
_SETTLED = 1e-10  # relative decrease of the cost below which the minimum is reached
_AGREED = 0.02  # relative change of the ratio of both variances below which it is found
_ROUNDING_PX = 1e-9  # residuals below this are of rounding, and tell nothing of the board
_UNDAMPED = 1e-9  # share of its curvature, added to a direction, that no longer shortens the step

# OpenCV 4 keeps them in its module for these lenses, OpenCV 5 with all others; their values differ.
_FISHEYE_FLAGS = sum(
    getattr(cv2.fisheye, name, getattr(cv2, name, 0))
    for name in ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW", "CALIB_FIX_K3", "CALIB_FIX_K4")
)

Model = Literal["radtan", "equidistant"]

PITCH_SIGMA = 1e-4
"""How well a board's pitch is known (relative): a caliper's 0.02 mm over 200 mm."""

PARAMETERS = tuple(
    f"{side}.{name}" for side in ("left", "right") for name in ("fu", "fv", "pu", "pv", "c1", "c2", "c3", "c4")
) + tuple(f"T_right_left.{name}" for name in ("x", "y", "z", "rx", "ry", "rz"))
"""Rows of the covariance: intrinsics (px) and distortion coefficients of both cameras; δ = (mm, rad) of T_right_left ·
exp(δ)."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Points of the board that were found in one image."""

    cell: Int[np.ndarray, "n 2"]
    """Column and row of each point on the board; the first point and the directions are the same in all images."""
    uv_px: Float[np.ndarray, "n 2"]
    """Where it was found (px); of a dot, the centre of its ellipse, uncorrected for eccentricity."""
    radius_px: Float[np.ndarray, "n"]
    """Long semi-axis of the dot's ellipse (px); zero for a corner."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The board as one pair of images shows it."""

    name: str
    """What people call the pair."""
    left: Sighting | None
    """What the left image shows of it; None for nothing."""
    right: Sighting | None
    """The same for the right one."""

    @property
    def is_pair(self) -> bool:
        """Whether both cameras see the board."""
        return self.left is not None and self.right is not None


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Every point found, and by how much the calibration misses it."""

    view: Int[np.ndarray, "m"]
    """Row of the view."""
    camera: Int[np.ndarray, "m"]
    """0 left, 1 right."""
    cell: Int[np.ndarray, "m 2"]
    """Column and row of the point on the board."""
    uv_px: Float[np.ndarray, "m 2"]
    """Where it was found (px)."""
    error_px: Float[np.ndarray, "m 2"]
    """Found less projected (px)."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated rig, how uncertain it is, and what it leaves of each view."""

    rig: StereoRig
    """The rig."""
    cov: Float[np.ndarray, "22 22"]
    """Covariance of ``PARAMETERS``, for errors in the images and on the board as large as the residuals tell."""
    image_sigma_px: float
    """Standard deviation per coordinate of a point in an image (px)."""
    board_sigma_mm: float
    """Standard deviation per coordinate of a point on the board (mm), from what its images have in common, or given."""
    views: tuple[BoardView, ...]
    """All views that were given."""
    is_left_out: Bool[np.ndarray, "v"]
    """Which of them had no say, as their residuals stand out."""
    T_left_board: tuple[Pose, ...]
    """Pose of the board in each view."""
    residuals: Residuals
    """Of all points, also those of views left out."""
    board_cell: Int[np.ndarray, "n 2"]
    """Column and row of each of the board's points."""
    board_mm: Float[np.ndarray, "n 3"]
    """By how much each is out of place, in board coordinates (mm); zero where that was not sought."""
    scale_sigma: float
    """Standard deviation of the board's size, relative: all lengths are as right as this. Part of the covariance."""

    @property
    def is_board_sought(self) -> bool:
        """Whether the places of the board's points were unknowns."""
        return bool(self.board_mm.any())

    @property
    def sigma(self) -> Float[np.ndarray, "22"]:
        """Standard deviation of each of ``PARAMETERS``."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    @property
    def baseline_sigma_mm(self) -> float:
        """Standard deviation of the baseline (mm)."""
        T = self.rig.T_right_left
        along = T.R.T @ T.t_mm / self.rig.baseline_mm  # |t + R ρ| = |t| + (t/|t|)ᵀ R ρ
        return float(np.sqrt(along @ self.cov[-6:-3, -6:-3] @ along))

    @property
    def rms_px(self) -> float:
        """Root mean square of the distances between points found and projected, without the views left out (px)."""
        return _rms(self.residuals.error_px[~self.is_left_out[self.residuals.view]])

    @property
    def view_rms_px(self) -> Float[np.ndarray, "v 2"]:
        """The same for each view and camera; NaN where the camera does not see the board."""
        at = self.residuals
        return np.array(
            [
                [_rms(at.error_px[(at.view == v) & (at.camera == camera)]) for camera in (0, 1)]
                for v in range(len(self.views))
            ]
        )

    @property
    def epipolar_rms_px(self) -> float:
        """Rms distance of points that both cameras see from one another's epipolar lines, without views left out (px).

        Sampson's: the misfit over what an error of one pixel in every coordinate makes (Hartley & Zisserman 2004,
        eq. 11.9); nothing is fitted to it, and no pose of the board enters.
        """
        misfits = []
        for view, is_out in zip(self.views, self.is_left_out, strict=True):
            if view.left is not None and view.right is not None and not is_out:
                of_left, of_right = _common(view.left, view.right)
                misfits.append(_sampson_px(self.rig, view.left.uv_px[of_left], view.right.uv_px[of_right]))
        return float(np.sqrt(np.mean(np.concatenate(misfits) ** 2)))

    @property
    def tilt_rad(self) -> float:
        """The largest angle between the board's planes in two views that had a say (rad)."""
        normal = np.array([T.R[:, 2] for T, out in zip(self.T_left_board, self.is_left_out, strict=True) if not out])
        return float(np.arccos(np.clip(normal @ normal.T, -1, 1)).max())


def calibrate(
    views: Sequence[BoardView],
    pitch_mm: float,
    left_size_px: tuple[int, int],
    right_size_px: tuple[int, int],
    model: Model = "radtan",
    may_leave_out: bool = True,
    board_sigma_mm: float | None = None,
    pitch_sigma: float = PITCH_SIGMA,
) -> Calibration:
    """The rig that explains all views, but for those whose residuals stand out.

    The board's points may be out of place by ``board_sigma_mm`` per coordinate, None for as much as the residuals tell,
    0 for holding them where they are meant to be, as fewer than ``ENOUGH_VIEWS`` views do. ``pitch_sigma`` is how well
    the pitch is known, relative.

    Sizes are (width, height). Left out is one view at a time, the worst, as long as it exceeds ``OUTLIER`` times the
    median and half of the views remain.

    Raises:
        CalibrationError: there are too few views, or they are too much alike to determine the rig.
    """
    pairs = sum(view.is_pair for view in views)
    if pairs < LEAST_VIEWS:
        raise CalibrationError(
            f"both cameras see the board in {pairs} image pairs, expected at least {LEAST_VIEWS}, better 15: hold the "
            f"board so that both see it, and tilt it differently for each."
        )
    observed = _Observed.of(views, pitch_mm)
    is_kept = np.ones(len(views), dtype=bool)
    while True:
        kept = np.flatnonzero(is_kept).tolist()
        rig = _start([views[v] for v in kept], pitch_mm, left_size_px, right_size_px, model)
        poses = tuple(_board_pose(rig, view, pitch_mm) for view in views)
        fit = _Fit(rig, poses, np.zeros_like(observed.printed_mm))
        observed = observed.with_radius(fit)
        fit = _adjust(fit, observed, is_kept)
        uncertainty = _uncertainty(fit, observed, is_kept)
        if len(kept) >= ENOUGH_VIEWS and board_sigma_mm != 0.0:
            fit, uncertainty = _seek_board(fit, observed, is_kept, uncertainty, board_sigma_mm)
        error_px = _errors(fit, observed)
        rms_px = np.array([_rms(error_px[observed.view == v]) for v in range(len(views))])
        worst = max(kept, key=lambda v: float(rms_px[v]))
        is_enough = sum(views[v].is_pair for v in kept if v != worst) >= max(LEAST_VIEWS, pairs / 2)
        if not (may_leave_out and is_enough and rms_px[worst] > OUTLIER * np.median(rms_px[kept])):
            break
        is_kept[worst] = False
    _refuse_vague(fit.rig, uncertainty.cov, len(kept))
    size_mm = np.linalg.norm(observed.printed_mm - observed.printed_mm.mean(axis=0))
    cov, T = uncertainty.cov.copy(), fit.rig.T_right_left
    cov[-6:-3, -6:-3] += pitch_sigma**2 * np.outer(T.R.T @ T.t_mm, T.R.T @ T.t_mm)  # of all the baseline alone scales
    return Calibration(
        rig=fit.rig,
        cov=cov,
        image_sigma_px=uncertainty.image_sigma_px,
        board_sigma_mm=uncertainty.board_sigma_mm,
        views=tuple(views),
        is_left_out=~is_kept,
        T_left_board=fit.poses,
        residuals=Residuals(observed.view, observed.camera, observed.cell, observed.uv_px, error_px),
        board_cell=observed.board_cell,
        board_mm=fit.board_mm,
        scale_sigma=float(np.hypot(pitch_sigma, uncertainty.board_sigma_mm / size_mm)),
    )


def _refuse_vague(rig: StereoRig, cov: Float[np.ndarray, "22 22"], views: int) -> None:
    """Refuses a rig whose focal lengths could as well be others."""
    focal_px = np.array([rig.left.fu_px, rig.left.fv_px, rig.right.fu_px, rig.right.fv_px])
    vague = np.sqrt(np.diag(cov)[[0, 1, _CAMERA, _CAMERA + 1]]) / focal_px
    if not vague.max() <= _WORST_FOCAL:
        raise CalibrationError(
            f"the {views} views leave a focal length uncertain by {100 * vague.max():.3g} % (one sigma), expected at "
            f"most {100 * _WORST_FOCAL:g} %: they are too much alike; tilt the board by 20 to 45 degrees about "
            f"different axes."
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Observed:
    """All sightings one below the other, those of a view together."""

    view: Int[np.ndarray, "m"]
    camera: Int[np.ndarray, "m"]
    cell: Int[np.ndarray, "m 2"]
    place: Int[np.ndarray, "m"]
    """Row among the board's points."""
    uv_px: Float[np.ndarray, "m 2"]
    radius_px: Float[np.ndarray, "m"]
    board_cell: Int[np.ndarray, "n 2"]
    """Column and row of each of the board's points."""
    printed_mm: Float[np.ndarray, "n 3"]
    """Where they are meant to be."""
    radius_mm: float = 0.0
    """Radius of the dots; zero for corners."""

    @staticmethod
    def of(views: Sequence[BoardView], pitch_mm: float) -> "_Observed":
        seen = [
            (v, camera, sighting)
            for v, view in enumerate(views)
            for camera, sighting in enumerate((view.left, view.right))
            if sighting is not None
        ]
        count = [len(sighting.uv_px) for _, _, sighting in seen]
        cell = np.concatenate([sighting.cell for _, _, sighting in seen])
        board_cell, place = np.unique(cell, axis=0, return_inverse=True)
        return _Observed(
            view=np.repeat([v for v, _, _ in seen], count),
            camera=np.repeat([camera for _, camera, _ in seen], count),
            cell=cell,
            place=place.ravel(),
            uv_px=np.concatenate([sighting.uv_px for _, _, sighting in seen]),
            radius_px=np.concatenate([sighting.radius_px for _, _, sighting in seen]),
            board_cell=board_cell,
            printed_mm=_on_board(board_cell, pitch_mm),
        )

    def with_radius(self, fit: "_Fit") -> "_Observed":
        """The same, the dots as large as most of them look: a tilted circle's image has the long semi-axis r f / z."""
        xyz = _in_cameras(fit, self)[0]
        focal_px = np.array([np.sqrt(c.fu_px * c.fv_px) for c in (fit.rig.left, fit.rig.right)])[self.camera]
        return replace(self, radius_mm=float(np.median(self.radius_px * xyz[:, 2] / focal_px)))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """What is sought."""

    rig: StereoRig
    poses: tuple[Pose, ...]
    """T_left_board of each view."""
    board_mm: Float[np.ndarray, "n 3"]
    """By how much each point of the board is out of place."""

    def moved(self, shared: Float[np.ndarray, "s"], of_poses: Float[np.ndarray, "v 6"]) -> "_Fit":
        """The fit after a step of rig and board, if that may move, and one of each pose."""
        board_mm = self.board_mm + shared[_RIG:].reshape(-1, 3) if len(shared) > _RIG else self.board_mm
        poses = tuple(pose @ Pose.exp(step) for pose, step in zip(self.poses, of_poses, strict=True))
        return _Fit(_moved(self.rig, shared[:_RIG]), poses, board_mm)


def _on_board(cell: Int[np.ndarray, "n 2"], pitch_mm: float) -> Float[np.ndarray, "n 3"]:
    return np.asarray(np.c_[cell * pitch_mm, np.zeros(len(cell))])


def _common(left: Sighting, right: Sighting) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Rows, left and right, of the points that both images show."""
    row_of = {tuple(cell): row for row, cell in enumerate(right.cell.tolist())}
    rows = [(k, row_of[tuple(cell)]) for k, cell in enumerate(left.cell.tolist()) if tuple(cell) in row_of]
    at = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return at[:, 0], at[:, 1]


def _rms(error_px: Float[np.ndarray, "m 2"]) -> float:
    return float(np.sqrt(np.mean(np.sum(error_px**2, axis=1)))) if len(error_px) else np.nan


def _sampson_px(
    rig: StereoRig, left_px: Float[np.ndarray, "n 2"], right_px: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    E = essential_matrix(rig)
    xy_left, xy_right = rig.left.unproject(left_px), rig.right.unproject(right_px)
    line_right, line_left = np.c_[xy_left, np.ones(len(xy_left))] @ E.T, np.c_[xy_right, np.ones(len(xy_right))] @ E
    misfit = np.sum(line_right * np.c_[xy_right, np.ones(len(xy_right))], axis=1)
    by_left = np.einsum("ni,nij->nj", line_left[:, :2], rig.left.unproject_jacobian(xy_left))
    by_right = np.einsum("ni,nij->nj", line_right[:, :2], rig.right.unproject_jacobian(xy_right))
    return np.asarray(misfit / np.sqrt(np.sum(by_left**2, axis=1) + np.sum(by_right**2, axis=1)))


def _start(
    views: Sequence[BoardView],
    pitch_mm: float,
    left_size_px: tuple[int, int],
    right_size_px: tuple[int, int],
    model: Model,
) -> StereoRig:
    """OpenCV's calibration: each camera by itself, then their relative pose with the cameras held."""
    try:
        left = _start_camera([view.left for view in views], pitch_mm, left_size_px, model)
        right = _start_camera([view.right for view in views], pitch_mm, right_size_px, model)
        return StereoRig(left, right, _start_pose(views, pitch_mm, left, right))
    except cv2.error as fault:
        raise CalibrationError(
            f"the {len(views)} views do not determine the rig ({fault.err}): tilt the board by 20 to 45 degrees about "
            f"different axes, and show it in all parts of both images."
        ) from None


def _start_camera(
    sightings: Sequence[Sighting | None], pitch_mm: float, size_px: tuple[int, int], model: Model
) -> Camera:
    seen = [each for each in sightings if each is not None]
    xyz = [_on_board(each.cell, pitch_mm).astype(np.float32)[None] for each in seen]
    uv = [each.uv_px.astype(np.float32)[None] for each in seen]
    if model == "equidistant":
        _, K, coefficients, *_ = cv2.fisheye.calibrate(
            xyz, uv, size_px, np.eye(3), np.zeros((4, 1)), None, None, _FISHEYE_FLAGS
        )
    else:
        _, K, coefficients, *_ = cv2.calibrateCamera(xyz, uv, size_px, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3)
    c1, c2, c3, c4 = np.ravel(coefficients)[:4].tolist()
    return Camera(
        float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *size_px, model=model,
        coefficients=(c1, c2, c3, c4),
    )  # fmt: skip


def _start_pose(views: Sequence[BoardView], pitch_mm: float, left: Camera, right: Camera) -> Pose:
    """``T_right_left`` from the points that both cameras see; undistorted before, as OpenCV knows but radtan here."""
    xyz, uv_left, uv_right = [], [], []
    for view in views:
        if view.left is None or view.right is None:
            continue
        of_left, of_right = _common(view.left, view.right)
        if len(of_left) >= LEAST_POINTS:
            xyz.append(_on_board(view.left.cell[of_left], pitch_mm).astype(np.float32)[:, None])
            uv_left.append(_undistorted_px(left, view.left.uv_px[of_left]))
            uv_right.append(_undistorted_px(right, view.right.uv_px[of_right]))
    if not xyz:
        raise CalibrationError(
            f"the cameras never see the same {LEAST_POINTS} points of the board: hold it so that both see most of it."
        )
    size_px = (left.width_px, left.height_px)  # has no say where the cameras are held
    none = np.zeros(5)
    found = cv2.stereoCalibrateExtended(
        xyz, uv_left, uv_right, left.K, none, right.K, none.copy(), size_px, np.eye(3), np.zeros(3),
        flags=cv2.CALIB_FIX_INTRINSIC, criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-4),
    )  # fmt: skip
    return Pose(np.asarray(found[5], dtype=float), np.ravel(found[6]).astype(float))


def _undistorted_px(camera: Camera, uv_px: Float[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 1 2"]:
    """Where a pinhole with the same focal lengths would have seen what a camera saw."""
    uv = camera.unproject(uv_px) * [camera.fu_px, camera.fv_px] + [camera.pu_px, camera.pv_px]
    return np.asarray(uv[:, None], dtype=np.float32)


def _board_pose(rig: StereoRig, view: BoardView, pitch_mm: float) -> Pose:
    """``T_left_board`` of a view by itself.

    A flat board seen from afar has two poses that one image can hardly tell apart (Collins & Bartoli 2014, IPPE): of
    both images' candidates the one that explains both best is taken.
    """
    seen = [
        (camera, T_camera_left, _on_board(sighting.cell, pitch_mm), sighting.uv_px)
        for camera, T_camera_left, sighting in (
            (rig.left, Pose.identity(), view.left),
            (rig.right, rig.T_right_left, view.right),
        )
        if sighting is not None
    ]
    best, least = Pose.identity(), np.inf
    for camera, T_camera_left, xyz, uv in seen:
        slopes = camera.unproject(uv)
        _, turns, shifts, _ = cv2.solvePnPGeneric(xyz, slopes, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        for turn, shift in zip(turns, shifts, strict=True):
            R = np.asarray(cv2.Rodrigues(turn)[0], dtype=float)
            T = T_camera_left.inverse() @ Pose(R, np.ravel(shift).astype(float))
            error = sum(float(np.sum((c.project((T_c @ T).apply(x)) - p) ** 2)) for c, T_c, x, p in seen)
            if error < least:
                best, least = T, error
    return best


def _adjust(fit: _Fit, observed: _Observed, is_kept: Bool[np.ndarray, "v"], stiffness: float | None = None) -> _Fit:
    """Least squares over rig and poses, and over the board where it has a stiffness (px²/mm²).

    Levenberg-Marquardt, the poses eliminated. Views left out have no say in the rig; their poses follow it.
    """
    holds = stiffness or 0.0
    damping, cost = 1e-6, _cost(fit, observed, is_kept, holds)
    for _ in range(100):
        system = _linearise(fit, observed, is_kept, stiffness)
        while True:
            tried = fit.moved(*_solve(system, damping))
            tried_cost = _cost(tried, observed, is_kept, holds)
            if tried_cost <= cost or damping > 1e6:
                break
            damping *= 10
        if not tried_cost <= cost:
            break
        # A damped step may be short although the minimum is far, along a valley: it does not end the search.
        is_settled = cost - tried_cost <= _SETTLED * cost and damping < _UNDAMPED
        fit, cost, damping = tried, tried_cost, damping / 10
        if is_settled:
            break
    return fit


@dataclass(frozen=True, slots=True, eq=False)
class _Uncertainty:
    """How wrong images and board are, and the rig for it."""

    cov: Float[np.ndarray, "22 22"]
    image_sigma_px: float
    board_sigma_mm: float


def _uncertainty(fit: _Fit, observed: _Observed, is_kept: Bool[np.ndarray, "v"]) -> _Uncertainty:
    """Covariance of the rig where points err in the images, each by itself, and on the board, in all images alike.

    Residuals are r = M (ε + G d), with errors ε in the images (σ per coordinate), d on the board (τ), G the derivative
    of pixels by places on the board, and M = I − J (JᵀJ)⁻¹ Jᵀ. With K = G Gᵀ the two variances follow from

        E rᵀ r   = σ² tr M   + τ² tr MK
        E rᵀ K r = σ² tr MK  + τ² tr MKMK

    and the covariance of all unknowns is σ² (JᵀJ)⁻¹ + τ² (JᵀJ)⁻¹ Jᵀ K J (JᵀJ)⁻¹.
    """
    kept = np.flatnonzero(is_kept).tolist()
    error_px = _errors(fit, observed)
    xyz_mm = observed.printed_mm + fit.board_mm
    unknowns, n = _RIG + 6 * len(kept), 3 * len(xyz_mm)
    JJ, JG, GG, Gr = np.zeros((unknowns, unknowns)), np.zeros((unknowns, n)), np.zeros((n, n)), np.zeros(n)
    coordinates, squares = 0, 0.0
    for k, v in enumerate(kept):
        own = np.r_[:_RIG, _RIG + 6 * k : _RIG + 6 * k + 6]
        for camera in (0, 1):
            rows = np.flatnonzero((observed.view == v) & (observed.camera == camera))
            J_rig, J_pose = _jacobians(fit.rig, fit.poses[v], camera, xyz_mm[observed.place[rows]])
            J, G = np.c_[J_rig, J_pose], np.zeros((2 * len(rows), n))
            for axis in range(3):  # shifts the point as a shift of the board would: the pose's first columns
                G[np.arange(2 * len(rows)), 3 * np.repeat(observed.place[rows], 2) + axis] = J_pose[:, axis]
            e = error_px[rows].ravel()
            JJ[np.ix_(own, own)] += J.T @ J
            JG[own] += J.T @ G
            GG += G.T @ G
            Gr += G.T @ e
            coordinates += len(e)
            squares += float(e @ e)
    freedom = coordinates - unknowns
    if freedom <= 0:
        raise CalibrationError(
            f"{coordinates // 2} points in {len(kept)} views are too few to calibrate from: take more views."
        )
    P = _inverse(JJ)
    W = GG - JG.T @ P @ JG  # Gᵀ M G
    moments = np.array([[freedom, np.trace(W)], [np.trace(W), np.sum(W**2)]])
    image, board = (float(x) for x in np.linalg.solve(moments, np.array([squares, Gr @ Gr])))
    if board < 0 or image < 0:  # nothing speaks for errors of the board
        image, board = squares / freedom, 0.0
    spread = (P @ JG)[:_RIG]
    return _Uncertainty(
        image * P[:_RIG, :_RIG] + board * spread @ spread.T, float(np.sqrt(image)), float(np.sqrt(board))
    )


def _seek_board(
    fit: _Fit,
    observed: _Observed,
    is_kept: Bool[np.ndarray, "v"],
    held: _Uncertainty,
    board_sigma_mm: float | None,
) -> tuple[_Fit, _Uncertainty]:
    """The fit with the board's points as unknowns (Strobl & Hirzinger 2011), where residuals tell that they err.

    Each coordinate is drawn to where it is meant to be by a prior of variance τ²; what no image tells, the board's
    place and size, stays there. With P the inverse of the normal equations, γ = n − (σ/τ)² tr P_dd of n coordinates are
    told by the images, and the variances are those that explain their own estimates (MacKay 1992, section 4):

        τ² = |d|² / γ,    σ² = |r|² / (coordinates found − parameters of rig and poses − γ).
    """
    n = observed.printed_mm.size
    freedom = 2 * int(np.count_nonzero(is_kept[observed.view])) - _RIG - 6 * int(np.count_nonzero(is_kept))
    image, board = held.image_sigma_px**2, held.board_sigma_mm**2 if board_sigma_mm is None else board_sigma_mm**2
    if freedom <= n or not board > 0.0 or not held.image_sigma_px > _ROUNDING_PX:
        return fit, held
    sought = fit
    for _ in range(20):
        stiffness = image / board
        sought = _adjust(sought, observed, is_kept, stiffness)
        P = _inverse(_reduced(_linearise(sought, observed, is_kept, stiffness), 0.0)[0])
        told = n - stiffness * float(np.trace(P[_RIG:, _RIG:]))
        image = float(np.sum(_errors(sought, observed)[is_kept[observed.view]] ** 2)) / (freedom - told)
        if board_sigma_mm is None:
            if told < 1.0:
                return fit, held
            board = float(np.sum(sought.board_mm**2)) / told
        if abs(image / board - stiffness) <= _AGREED * stiffness:
            break
    return sought, _Uncertainty(image * P[:_RIG, :_RIG], float(np.sqrt(image)), float(np.sqrt(board)))


def _inverse(A: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Inverse of normal equations; very large, not infinite, along what they leave undetermined."""
    scale = 1 / np.sqrt(np.diag(A).clip(1e-300))  # or the units would decide what is undetermined
    values, vectors = np.linalg.eigh(A * scale * scale[:, None])
    half = scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-14))
    return np.asarray(half @ half.T)


_System = tuple[
    Float[np.ndarray, "s s"],
    Float[np.ndarray, "s"],
    Float[np.ndarray, "v s 6"],
    Float[np.ndarray, "v 6 6"],
    Float[np.ndarray, "v 6"],
    Bool[np.ndarray, "v"],
]
"""Normal equations: of rig and board, across, and of each pose; and which views have a say in the former."""


def _linearise(
    fit: _Fit, observed: _Observed, is_kept: Bool[np.ndarray, "v"], stiffness: float | None = None
) -> _System:
    error = _errors(fit, observed)
    xyz_mm = observed.printed_mm + fit.board_mm
    views, shared = len(fit.poses), _RIG + (0 if stiffness is None else fit.board_mm.size)
    A, g = np.zeros((shared, shared)), np.zeros(shared)
    B, C, h = np.zeros((views, shared, 6)), np.zeros((views, 6, 6)), np.zeros((views, 6))
    if stiffness is not None:
        A[range(_RIG, shared), range(_RIG, shared)] = stiffness
        g[_RIG:] = -stiffness * fit.board_mm.ravel()
    for v, T in enumerate(fit.poses):
        for camera in (0, 1):
            rows = np.flatnonzero((observed.view == v) & (observed.camera == camera))
            J_rig, J_pose = _jacobians(fit.rig, T, camera, xyz_mm[observed.place[rows]])
            e = error[rows].ravel()
            C[v] += J_pose.T @ J_pose
            h[v] += J_pose.T @ e
            if not is_kept[v]:
                continue
            A[:_RIG, :_RIG] += J_rig.T @ J_rig
            g[:_RIG] += J_rig.T @ e
            B[v, :_RIG] += J_rig.T @ J_pose
            if stiffness is not None:
                # Where a point goes is where a shift of the board would take it: the pose's first columns.
                J = J_pose.reshape(-1, 2, 6)
                G = J[:, :, :3]
                at = _RIG + 3 * observed.place[rows, None] + np.arange(3)
                A[at[:, :, None], at[:, None, :]] += np.einsum("nka,nkb->nab", G, G)
                across = np.einsum("nkr,nka->nar", J_rig.reshape(-1, 2, _RIG), G)
                A[at, :_RIG] += across
                A[:_RIG, at] += np.moveaxis(across, 2, 0)
                g[at] += np.einsum("nka,nk->na", G, error[rows])
                B[v, at] += np.einsum("nka,nkp->nap", G, J)
    return A, g, B, C, h, is_kept


def _jacobians(
    rig: StereoRig, T_left_board: Pose, camera: int, xyz_mm: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "m 22"], Float[np.ndarray, "m 6"]]:
    """d(u, v) of points on the board by the parameters of the rig and by δ of T_left_board · exp(δ); m = 2 n."""
    in_left = T_left_board.apply(xyz_mm)
    R = T_left_board.R
    J_rig = np.zeros((len(xyz_mm), 2, _RIG))
    if camera == 0:
        J_rig[:, :, :_CAMERA] = _camera_jacobian(rig.left, in_left)
        J_point = rig.left.project_jacobian(in_left)
    else:
        in_right = rig.T_right_left.apply(in_left)
        J_rig[:, :, _CAMERA : 2 * _CAMERA] = _camera_jacobian(rig.right, in_right)
        J_point = rig.right.project_jacobian(in_right) @ rig.T_right_left.R
        J_rig[:, :, -6:] = J_point @ _moving(in_left)
    return J_rig.reshape(-1, _RIG), (J_point @ R @ _moving(xyz_mm)).reshape(-1, 6)


def _moving(xyz_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 6"]:
    """d(exp(δ) p) / dδ at δ = 0: [I, −[p]×]."""
    J = np.zeros((len(xyz_mm), 3, 6))
    J[:, [0, 1, 2], [0, 1, 2]] = 1.0
    J[:, [0, 1, 2], [4, 5, 3]] = xyz_mm[:, [2, 0, 1]]
    J[:, [0, 1, 2], [5, 3, 4]] = -xyz_mm[:, [1, 2, 0]]
    return J


def _camera_jacobian(camera: Camera, xyz_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 8"]:
    """d(u, v) / d(fu, fv, pu, pv, c1, c2, c3, c4); both models are linear in their coefficients."""
    xy = xyz_mm[:, :2] / xyz_mm[:, 2:]
    distorted, plain = (distort(camera.model, c, xy) for c in (camera.coefficients, (0.0,) * 4))
    J = np.zeros((len(xy), 2, _CAMERA))
    for axis, focal_px in enumerate((camera.fu_px, camera.fv_px)):
        J[:, axis, axis] = distorted[:, axis]
        J[:, axis, 2 + axis] = 1.0
        for k in range(4):
            one = tuple(float(k == i) for i in range(4))
            J[:, axis, 4 + k] = focal_px * (distort(camera.model, one, xy) - plain)[:, axis]
    return J


def _reduced(
    system: _System, damping: float
) -> tuple[Float[np.ndarray, "s s"], Float[np.ndarray, "s"], Float[np.ndarray, "v 6 6"]]:
    """The normal equations of rig and board after the poses are eliminated, and the inverse of each pose's own."""
    A, g, B, C, h, is_kept = system
    inverse = np.linalg.inv(C + damping * np.einsum("vij,ij->vij", C, np.eye(6)))
    across = np.moveaxis(B[is_kept], 0, 1).reshape(len(A), -1)
    by_pose = np.moveaxis(B[is_kept] @ inverse[is_kept], 0, 1).reshape(len(A), -1)
    return A + damping * np.diag(np.diag(A)) - by_pose @ across.T, g - by_pose @ h[is_kept].ravel(), inverse


def _solve(system: _System, damping: float) -> tuple[Float[np.ndarray, "s"], Float[np.ndarray, "v 6"]]:
    """The step of rig and board, and of each pose; those of views left out only seek their own minimum."""
    _, _, B, _, h, _ = system
    S, g, inverse = _reduced(system, damping)
    scale = 1 / np.sqrt(np.diag(S).clip(1e-300))
    if len(S) == _RIG:
        step = scale * np.linalg.lstsq(S * scale * scale[:, None], scale * g, rcond=1e-14)[0]
    else:
        step = scale * np.linalg.solve(S * scale * scale[:, None], scale * g)
    return step, np.einsum("vkl,vl->vk", inverse, h - np.einsum("vik,i->vk", B, step))


def _moved(rig: StereoRig, step: Float[np.ndarray, "22"]) -> StereoRig:
    return StereoRig(
        _moved_camera(rig.left, step[:_CAMERA]),
        _moved_camera(rig.right, step[_CAMERA : 2 * _CAMERA]),
        rig.T_right_left @ Pose.exp(step[-6:]),
    )


def _moved_camera(camera: Camera, step: Float[np.ndarray, "8"]) -> Camera:
    fu, fv, pu, pv, *coefficients = (parameters_of(camera) + step).tolist()
    return Camera(fu, fv, pu, pv, camera.width_px, camera.height_px, camera.model, tuple(coefficients))


def parameters_of(camera: Camera) -> Float[np.ndarray, "8"]:
    """What is estimated of a camera, in the order of ``PARAMETERS``."""
    return np.array([camera.fu_px, camera.fv_px, camera.pu_px, camera.pv_px, *camera.coefficients])


def _errors(fit: _Fit, observed: _Observed) -> Float[np.ndarray, "m 2"]:
    """Found less projected (px)."""
    seen = _ellipse_centres(*_in_cameras(fit, observed), observed.radius_mm)
    projected = np.where(observed.camera[:, None] == 0, fit.rig.left.project(seen), fit.rig.right.project(seen))
    return np.asarray(observed.uv_px - projected)


def _in_cameras(fit: _Fit, observed: _Observed) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3 3"]]:
    """Each point and the axes of its board in the coordinates of the camera that has seen it."""
    T = [(pose, fit.rig.T_right_left @ pose) for pose in fit.poses]
    R = np.array([[each.R for each in both] for both in T])[observed.view, observed.camera]
    t_mm = np.array([[each.t_mm for each in both] for both in T])[observed.view, observed.camera]
    xyz_mm = (observed.printed_mm + fit.board_mm)[observed.place]
    return np.einsum("nij,nj->ni", R, xyz_mm) + t_mm, R


def _ellipse_centres(
    xyz_mm: Float[np.ndarray, "m 3"], R: Float[np.ndarray, "m 3 3"], radius_mm: float
) -> Float[np.ndarray, "m 3"]:
    """Points that project to the centres of the ellipses as which circles around ``xyz_mm`` are seen.

    The dual conic of the image of a circle in the plane of R's first two columns is p pᵀ − r² (R₁ R₁ᵀ + R₂ R₂ᵀ), and
    the centre of a conic is the last column of its dual (Hartley & Zisserman 2004, section 2.2.3).
    """
    if radius_mm == 0.0:
        return xyz_mm
    z = xyz_mm[:, 2:]
    return np.asarray(xyz_mm - radius_mm**2 / z * np.einsum("nik,nk->ni", R[:, :, :2], R[:, 2, :2]))


def _cost(fit: _Fit, observed: _Observed, is_kept: Bool[np.ndarray, "v"], stiffness: float) -> float:
    """Sum of squares over the views that have a say, and of the board; infinite where a point is behind its camera."""
    cost = float(np.sum(_errors(fit, observed)[is_kept[observed.view]] ** 2) + stiffness * np.sum(fit.board_mm**2))
    return cost if np.isfinite(cost) else np.inf
