"""Bundle adjustment: all poses and targets at once, from every dot in both images or from every point.

The list is small and the frames are many, so the poses are eliminated frame by frame (Schur complement; Triggs et al.
2000, "Bundle adjustment: a modern synthesis", section 6.1); three unknowns a target remain, and the inverse of their
matrix is the joint covariance of the map. Cost grows linearly with the frames and with the cube of the targets.

Knows neither files nor how the targets were identified; the gauge is the caller's choice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.errors import AdjustmentError, ConfigError
from trifix.geometry.alignment import point_jacobian
from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose, skew
from trifix.kernels import adjustment as kernels

MOST_TARGETS = 3000
"""Beyond, the joint covariance takes more than 650 MB and its factorisation minutes."""

_SETTLED = 1e-8  # rms step in standard deviations at which the minimum is reached
_ROUNDED = 1e-5  # the same, where steps no longer shrink because rounding makes them
_NEAR = 0.01  # share of the cost that a step still takes when the loss may turn to the one that forgets outliers
_RADIAL = 0.1  # share of its curvature that a doubted residual keeps along itself
_NEGLIGIBLE = 1e-6  # expected decrease of the cost that its rounding may hide
_LEAST_PIVOT = 1e-11  # share of a column's information that the others must leave it


@dataclass(frozen=True, slots=True, eq=False)
class DotObservations:
    """Dots of both images, each with the target that it is; targets seen by one camera only among them."""

    frame: Int[np.ndarray, "m"]
    """Row of the pose."""
    target: Int[np.ndarray, "m"]
    """Row of the target."""
    camera: Int[np.ndarray, "m"]
    """0 left, 1 right."""
    uv_px: Float[np.ndarray, "m 2"]
    """Centre of the target's image (px)."""
    cov_px2: Float[np.ndarray, "m 2 2"]
    """Covariance of the centre (px²), noise scale applied."""

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class PointObservations:
    """Points in sensor coordinates, each with the target that it is."""

    frame: Int[np.ndarray, "m"]
    """Row of the pose."""
    target: Int[np.ndarray, "m"]
    """Row of the target."""
    xyz_mm: Float[np.ndarray, "m 3"]
    """Position, sensor coordinates (mm)."""
    cov_mm2: Float[np.ndarray, "m 3 3"]
    """Covariance (mm²), noise scale applied."""

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class ControlTargets:
    """Targets whose places in the world are known beforehand: a given map."""

    target: Int[np.ndarray, "c"]
    """Row of the target."""
    xyz_mm: Float[np.ndarray, "c 3"]
    """Position, world coordinates (mm)."""
    cov_mm2: Float[np.ndarray, "c 3 3"]
    """Covariance (mm²), positive definite; or zero, and the target stays exactly there."""


@dataclass(frozen=True, slots=True)
class ScaleBar:
    """Two targets at a known distance."""

    first: int
    """Row of one target."""
    second: int
    """Row of the other."""
    length_mm: float
    """Distance (mm)."""
    sigma_mm: float
    """Its standard deviation (mm)."""


@dataclass(frozen=True, slots=True)
class RigSigmas:
    """How far a calibration may be off: the standard deviations that a refined rig starts from."""

    rotation_rad: float = 0.01
    """Rotation of one camera against the other, about each axis (rad)."""
    translation_mm: float = 2.0
    """Place of one camera as seen from the other, along each axis (mm)."""
    focal_px: float = 20.0
    """Focal lengths (px)."""
    principal_px: float = 20.0
    """Principal points, each coordinate (px)."""
    distortion: float = 0.1
    """Coefficients of distortion."""

    def __post_init__(self) -> None:
        if min(self.rotation_rad, self.translation_mm, self.focal_px, self.principal_px, self.distortion) <= 0:
            raise ConfigError("A rig's standard deviations must all be positive.")


@dataclass(frozen=True, slots=True)
class AdjustOptions:
    """How observations are weighed, and when to stop."""

    doubt_sigmas: float = 3.0
    """Residuals of a dot up to here count in full (σ, both coordinates together; for points what is as rare)."""
    reject_sigmas: float = 9.0
    """Residuals from here on count for nothing; half-way there their pull begins to fade."""
    least_firmness: float = 10.0
    """Poses and targets whose standard deviation would exceed their distance (or a radian) over this are left out."""
    most_steps: int = 60
    """Steps after which the search for the minimum is given up."""

    def __post_init__(self) -> None:
        if not 0 < self.doubt_sigmas < self.reject_sigmas:
            raise ConfigError("doubt_sigmas must be positive, and reject_sigmas larger.")
        if self.least_firmness <= 0 or self.most_steps < 1:
            raise ConfigError("least_firmness must be positive, and most_steps at least 1.")


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """Poses, targets and rig of the least weighted residuals, with their covariances in the gauge asked for."""

    T_world_sensor: tuple[Pose, ...]
    """The f poses."""
    pose_cov: Float[np.ndarray, "f 6 6"]
    """Covariances of δ = (translation mm, rotation rad), T_true = T · exp(δ), the map's uncertainty included; zero for
    the frame that holds the gauge, NaN for those left out."""
    is_frame_adjusted: Bool[np.ndarray, "f"]
    """False where too little was seen to hold the pose: it is as it was given."""
    xyz_mm: Float[np.ndarray, "n 3"]
    """The targets, world coordinates (mm)."""
    map_cov_mm2: Float[np.ndarray, "k k"]
    """Joint covariance (mm²) of all targets, k = 3 n; zero for those held, NaN for those left out."""
    is_target_adjusted: Bool[np.ndarray, "n"]
    """False where too little was seen of the target: it is as it was given."""
    rig: StereoRig | None
    """The refined rig; None where none was to be refined."""
    rig_parameters: tuple[str, ...]
    """What was refined: δ of T_right_left · exp(δ), then focal lengths, principal points and distortion of both."""
    rig_change: Float[np.ndarray, "q"]
    """How far each of these is from the rig that was given."""
    rig_cov: Float[np.ndarray, "q q"]
    """Covariance of these."""
    weight: Float[np.ndarray, "m"]
    """What each observation counted for, 1 in full to 0 not at all."""
    chi2: float
    """Sum of the weighted squared residuals (σ²), the known places, lengths and calibration included."""
    dof: int
    """Observations less unknowns: what ``chi2`` should be."""
    steps: int
    """Steps that it took."""

    @property
    def target_cov_mm2(self) -> Float[np.ndarray, "n 3 3"]:
        """The covariance of each target by itself (mm²)."""
        n = len(self.xyz_mm)
        return self.map_cov_mm2.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]


def adjust(
    observations: DotObservations | PointObservations,
    T_world_sensor: Sequence[Pose],
    xyz_mm: Float[np.ndarray, "n 3"],
    *,
    rig: StereoRig | Sequence[StereoRig] | None = None,
    gauge: int | ControlTargets = 0,
    scale_bars: Sequence[ScaleBar] = (),
    refine_rig: RigSigmas | None = None,
    options: AdjustOptions = AdjustOptions(),
    watch: Callable[[], None] | None = None,
) -> Adjustment:
    """Poses and targets of the least robust residuals, begun from the given ones.

    ``rig`` is needed for dots: one for all frames, or one a frame. ``gauge`` says what the world is: the frame whose
    pose stays as it is, or targets known beforehand. With ``refine_rig`` the two cameras and their relative pose are
    unknowns too; the baseline keeps its length unless scale bars or known targets tell another. ``watch`` is called
    before every step, and may raise to end the search.

    Levenberg-Marquardt, which is Gauss-Newton wherever that descends, on iteratively reweighted residuals: Huber's
    loss until the minimum is near, then Hampel's in three parts, for which outliers count nothing.

    Raises:
        AdjustmentError: the observations do not determine the unknowns, contradict themselves, or are too many.
    """
    network = _Network(observations, len(T_world_sensor), len(xyz_mm), rig, gauge, scale_bars, refine_rig)
    start = _State(
        np.array([T.R for T in T_world_sensor]),
        np.array([T.t_mm for T in T_world_sensor]),
        np.where(network.is_held[:, None], network.control_xyz_mm, xyz_mm),
        network.rigs,
    )
    search = _Search(network, options, start)
    search.run(watch)
    return search.result(T_world_sensor)


# --- what was observed -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """What the search moves."""

    R: Float[np.ndarray, "f 3 3"]
    """Rotations of ``T_world_sensor``."""
    t_mm: Float[np.ndarray, "f 3"]
    """Translations (mm)."""
    xyz_mm: Float[np.ndarray, "n 3"]
    """The targets (mm)."""
    rigs: tuple[StereoRig, ...]
    """The distinct rigs; none for points."""


class _Network:
    """What was observed, sorted by frame, target and camera, and what it says about a state."""

    def __init__(
        self,
        observations: DotObservations | PointObservations,
        frames: int,
        targets: int,
        rig: StereoRig | Sequence[StereoRig] | None,
        gauge: int | ControlTargets,
        scale_bars: Sequence[ScaleBar],
        refine_rig: RigSigmas | None,
    ):
        _check(observations, frames, targets, gauge, scale_bars)
        self.frames, self.targets, self.scale_bars = frames, targets, scale_bars
        self.fixed = None if isinstance(gauge, ControlTargets) else gauge

        if isinstance(observations, DotObservations):
            camera, measured, cov = observations.camera, observations.uv_px, observations.cov_px2
            self.rigs, rig_of_frame = _distinct(rig, frames)
        else:
            camera, measured, cov = np.zeros(len(observations), int), observations.xyz_mm, observations.cov_mm2
            self.rigs, rig_of_frame = (), np.zeros(frames, int)
        self.order = np.lexsort((camera, observations.target, observations.frame))
        columns = observations.frame, observations.target, camera
        frame, target, camera = (each[self.order].astype(np.int64) for each in columns)
        self.measured = measured[self.order].astype(float)
        self.whitening = np.linalg.inv(np.linalg.cholesky(cov[self.order]))  # U with Uᵀ U = C⁻¹

        # sightings: one target in one frame, by one camera or both
        is_new = np.append(True, (np.diff(frame) != 0) | (np.diff(target) != 0))
        self.sighting = np.cumsum(is_new) - 1  # of each observation
        self.observation_start = np.append(np.flatnonzero(is_new), len(frame))
        self.frame, self.target = frame[is_new], target[is_new]
        self.start = np.searchsorted(self.frame, np.arange(frames + 1))

        self.through: list[tuple[int, int, np.ndarray]] = []  # rows of what one camera (0, 1) of one rig saw
        if self.rigs:
            key = 2 * rig_of_frame[frame] + camera
            rows = np.argsort(key, kind="stable")
            for group in np.split(rows, np.flatnonzero(np.diff(key[rows])) + 1):
                self.through.append((*divmod(int(key[group[0]]), 2), group))

        self.is_held = np.zeros(targets, dtype=bool)
        self.control = np.zeros((targets, 3, 3))  # information about targets known beforehand, unless held
        self.control_xyz_mm = np.zeros((targets, 3))
        if isinstance(gauge, ControlTargets):
            is_exact = ~gauge.cov_mm2.any(axis=(1, 2))
            self.is_held[gauge.target] = is_exact
            self.control[gauge.target[~is_exact]] = np.linalg.inv(gauge.cov_mm2[~is_exact])
            self.control_xyz_mm[gauge.target] = gauge.xyz_mm

        self.rig_unknowns: _RigUnknowns | None = None
        if refine_rig is not None:
            if len(self.rigs) != 1:
                raise AdjustmentError(
                    f"A rig can be refined where one was given for all frames, with dots; here are {len(self.rigs)}."
                )
            knows_scale = bool(scale_bars) or (isinstance(gauge, ControlTargets) and len(gauge.target) > 1)
            self.rig_unknowns = _RigUnknowns(self.rigs[0], refine_rig, knows_scale)

    def __len__(self) -> int:
        return len(self.sighting)

    def in_sensor_mm(self, state: _State) -> Float[np.ndarray, "s 3"]:
        """The target of each sighting in sensor coordinates."""
        xyz = np.empty((len(self.frame), 3))
        kernels.in_sensor(self.start, self.target, state.R, state.t_mm, state.xyz_mm, xyz)
        return xyz

    def residuals(self, state: _State) -> Float[np.ndarray, "m d"]:
        """Whitened residuals, measured less predicted; NaN for what is not in front of its camera."""
        xyz = self.in_sensor_mm(state)[self.sighting]
        predicted = np.empty_like(self.measured) if self.through else xyz
        for rig, camera, rows in self.through:
            predicted[rows] = _camera(state.rigs[rig], camera).project(_in_camera(state.rigs[rig], camera, xyz[rows]))
        return np.asarray(np.matmul(self.whitening, (self.measured - predicted)[:, :, None])[:, :, 0])

    def jacobians(
        self, state: _State, xyz_mm: Float[np.ndarray, "s 3"]
    ) -> tuple[Float[np.ndarray, "m d 3"], Float[np.ndarray, "m d q"]]:
        """Derivatives of the whitened predictions by the place in sensor coordinates and by the rig's unknowns."""
        unknowns = self.rig_unknowns
        J_rig = np.zeros((*self.measured.shape, 0 if unknowns is None else len(unknowns)))
        if not self.through:
            return self.whitening, J_rig
        xyz = xyz_mm[self.sighting]
        J = np.empty((*self.measured.shape, 3))
        for rig_row, camera, rows in self.through:
            rig = state.rigs[rig_row]
            in_camera = _in_camera(rig, camera, xyz[rows])
            J_camera = _camera(rig, camera).project_jacobian(in_camera)
            J[rows] = J_camera @ rig.T_right_left.R if camera else J_camera
            if unknowns is not None:
                J_rig[rows] = unknowns.jacobian(rig, camera, xyz[rows], in_camera, J[rows])
        return self.whitening @ J, self.whitening @ J_rig if unknowns is not None else J_rig


def _camera(rig: StereoRig, camera: int) -> Camera:
    return rig.right if camera else rig.left


def _in_camera(rig: StereoRig, camera: int, xyz_mm: Float[np.ndarray, "g 3"]) -> Float[np.ndarray, "g 3"]:
    return rig.T_right_left.apply(xyz_mm) if camera else xyz_mm


def _distinct(
    rig: StereoRig | Sequence[StereoRig] | None, frames: int
) -> tuple[tuple[StereoRig, ...], Int[np.ndarray, "f"]]:
    """The distinct rigs, and which one each frame has."""
    if rig is None:
        raise AdjustmentError("Dots can only be adjusted with the rig that saw them; none was given.")
    if isinstance(rig, StereoRig):
        return (rig,), np.zeros(frames, dtype=np.int64)
    if len(rig) != frames:
        raise AdjustmentError(f"{len(rig)} rigs were given for {frames} frames: give one for all or one for each.")
    row_of: dict[int, int] = {}
    of_frame = np.array([row_of.setdefault(id(each), len(row_of)) for each in rig])
    return tuple({id(each): each for each in rig}.values()), of_frame


def _check(
    observations: DotObservations | PointObservations,
    frames: int,
    targets: int,
    gauge: int | ControlTargets,
    scale_bars: Sequence[ScaleBar],
) -> None:
    """Refuses what names frames or targets that are not there, or is no number."""
    if not len(observations):
        raise AdjustmentError("There is nothing to adjust: no observation was given.")
    if targets > MOST_TARGETS:
        raise AdjustmentError(
            f"{targets} targets are too many to adjust together, the limit is {MOST_TARGETS}: adjust parts of the map."
        )
    named = [("frame", observations.frame, frames), ("target", observations.target, targets)]
    values, cov = _values(observations)
    if isinstance(observations, DotObservations):
        named.append(("camera", observations.camera, 2))
    if isinstance(gauge, ControlTargets):
        named.append(("known target", gauge.target, targets))
        if len(np.unique(gauge.target)) < len(gauge.target):
            raise AdjustmentError("A target is known twice: give each of the known targets one place.")
        is_exact = np.all(gauge.cov_mm2 == 0, axis=(1, 2))
        _check_numbers("known target", gauge.xyz_mm, np.where(is_exact[:, None, None], np.eye(3), gauge.cov_mm2))
    else:
        named.append(("gauge's frame", np.array([gauge]), frames))
    for bar in scale_bars:
        named.append(("scale bar's target", np.array([bar.first, bar.second]), targets))
        if bar.first == bar.second or not (0 < bar.sigma_mm < np.inf and 0 < bar.length_mm < np.inf):
            raise AdjustmentError(f"{bar} needs two different targets, a length and a sigma above zero.")
    for what, rows, limit in named:
        beyond = rows[(rows < 0) | (rows >= limit)]
        if len(beyond):
            raise AdjustmentError(f"There is no {what} {beyond[0]}: rows go to {limit - 1}.")
    _check_numbers("observation", values, cov)


def _values(observations: DotObservations | PointObservations) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(observations, DotObservations):
        return observations.uv_px, observations.cov_px2
    return observations.xyz_mm, observations.cov_mm2


def _check_numbers(what: str, values: Float[np.ndarray, "m d"], cov: Float[np.ndarray, "m d d"]) -> None:
    is_finite = np.isfinite(values).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    if not is_finite.all():
        raise AdjustmentError(f"{what.capitalize()} {np.argmin(is_finite)} holds a value that is not a finite number.")
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        worst = int(np.argmin(np.linalg.eigvalsh(cov)[:, 0]))
        raise AdjustmentError(f"The covariance of {what} {worst} is not positive definite.") from None


# --- the rig as an unknown -------------------------------------------------------------------------------------------


class _RigUnknowns:
    """δ of T_right_left · exp(δ) and the intrinsics of both cameras; the given ones are one more observation."""

    def __init__(self, rig: StereoRig, sigmas: RigSigmas, knows_scale: bool):
        self.given, self.knows_scale = rig, knows_scale
        places = ("x_mm", "y_mm", "z_mm") if knows_scale else ("across_1_mm", "across_2_mm")
        names = [*places, "x_rad", "y_rad", "z_rad"]
        sigma = [sigmas.translation_mm] * 3 + [sigmas.rotation_rad] * 3
        for side, camera in (("left", rig.left), ("right", rig.right)):
            all_names = ["k1", "k2", "p1", "p2", "k3"] if camera.model == "radtan" else ["k1", "k2", "k3", "k4"]
            coefficients = all_names[: len(camera.coefficients)]
            names += [f"{side}_{name}" for name in ("fu_px", "fv_px", "pu_px", "pv_px", *coefficients)]
            sigma += [sigmas.focal_px] * 2 + [sigmas.principal_px] * 2 + [sigmas.distortion] * len(coefficients)
        self.names, self.sigma = tuple(names), np.array(sigma)

    def __len__(self) -> int:
        return len(self.names)

    def _basis(self, rig: StereoRig) -> Float[np.ndarray, "6 e"]:
        """The directions of δ that are unknown: all, or those that leave the baseline's length as it is."""
        if self.knows_scale:
            return np.eye(6)
        along = rig.right_centre_mm / rig.baseline_mm
        across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        across /= np.linalg.norm(across)
        basis = np.zeros((6, 5))
        basis[:3, 0], basis[:3, 1], basis[3:, 2:] = across, np.cross(along, across), np.eye(3)
        return basis

    def moved(self, rig: StereoRig, step: Float[np.ndarray, "q"]) -> StereoRig:
        """The rig after a step."""
        basis = self._basis(rig)
        T = rig.T_right_left @ Pose.exp(basis @ step[: basis.shape[1]])
        if not self.knows_scale:
            T = Pose(T.R, T.t_mm * (self.given.baseline_mm / np.linalg.norm(T.t_mm)))
        split = basis.shape[1] + 4 + len(rig.left.coefficients)
        return StereoRig(_stepped(rig.left, step[basis.shape[1] : split]), _stepped(rig.right, step[split:]), T)

    def calibration(self, rig: StereoRig) -> tuple[Float[np.ndarray, "e"], Float[np.ndarray, "e q"]]:
        """How far the rig is from the given one, in standard deviations, and the derivative by a step.

        log(exp(δ) · exp(ε)) = δ + (1 + ad/2 + ad²/12 + O(δ⁴)) ε, with ad the adjoint of δ.
        """
        delta = (self.given.T_right_left.inverse() @ rig.T_right_left).log()
        ad = np.zeros((6, 6))
        ad[:3, :3] = ad[3:, 3:] = skew(delta[3:])
        ad[:3, 3:] = skew(delta[:3])
        basis = self._basis(rig)
        J = np.zeros((len(self.sigma), len(self)))
        J[:6, : basis.shape[1]] = (np.eye(6) + ad / 2 + ad @ ad / 12) @ basis
        J[6:, basis.shape[1] :] = np.eye(len(self.sigma) - 6)
        left = _intrinsics(rig.left) - _intrinsics(self.given.left)
        right = _intrinsics(rig.right) - _intrinsics(self.given.right)
        return np.concatenate([delta, left, right]) / self.sigma, J / self.sigma[:, None]

    def change(self, rig: StereoRig) -> Float[np.ndarray, "q"]:
        """How far each unknown is from the given one."""
        basis = self._basis(self.given)
        delta = (self.given.T_right_left.inverse() @ rig.T_right_left).log()
        left = _intrinsics(rig.left) - _intrinsics(self.given.left)
        right = _intrinsics(rig.right) - _intrinsics(self.given.right)
        return np.concatenate([basis.T @ delta, left, right])

    def jacobian(
        self,
        rig: StereoRig,
        camera: int,
        xyz_mm: Float[np.ndarray, "g 3"],
        in_camera_mm: Float[np.ndarray, "g 3"],
        J: Float[np.ndarray, "g 2 3"],
    ) -> Float[np.ndarray, "g 2 q"]:
        """d(u, v) / d(unknowns) of places in sensor coordinates, where ``J`` is d(u, v) / d(place)."""
        out = np.zeros((len(J), 2, len(self)))
        basis = self._basis(rig)
        first = basis.shape[1]
        split = first + 4 + len(rig.left.coefficients)
        if camera:
            out[:, :, :first] = J @ (point_jacobian(xyz_mm) @ basis)
            out[:, :, split:] = intrinsics_jacobian(rig.right, in_camera_mm)
        else:
            out[:, :, first:split] = intrinsics_jacobian(rig.left, in_camera_mm)
        return out


def _intrinsics(camera: Camera) -> Float[np.ndarray, "i"]:
    return np.array([camera.fu_px, camera.fv_px, camera.pu_px, camera.pv_px, *camera.coefficients])


def _stepped(camera: Camera, step: Float[np.ndarray, "i"]) -> Camera:
    fu, fv, pu, pv, *coefficients = (_intrinsics(camera) + step).tolist()
    return replace(camera, fu_px=fu, fv_px=fv, pu_px=pu, pv_px=pv, coefficients=tuple(coefficients))


def intrinsics_jacobian(camera: Camera, xyz_mm: Float[np.ndarray, "g 3"]) -> Float[np.ndarray, "g 2 i"]:
    """d(u, v) / d(fu, fv, pu, pv, coefficients of distortion) at points in camera coordinates."""
    xy = xyz_mm[:, :2] / xyz_mm[:, 2:]
    focal = np.array([camera.fu_px, camera.fv_px])
    J = np.zeros((len(xy), 2, 4 + len(camera.coefficients)))
    distorted = (camera.project(xyz_mm) - [camera.pu_px, camera.pv_px]) / focal
    J[:, 0, 0], J[:, 1, 1] = distorted.T
    J[:, 0, 2] = J[:, 1, 3] = 1.0
    x, y = xy.T
    r2 = x * x + y * y
    if camera.model == "radtan":
        tangential = (
            np.stack([2 * x * y, r2 + 2 * y * y], axis=1),
            np.stack([r2 + 2 * x * x, 2 * x * y], axis=1),
        )
        by_coefficient = [xy * r2[:, None], xy * r2[:, None] ** 2, *tangential, xy * r2[:, None] ** 3]
    else:  # equidistant
        r = np.maximum(np.sqrt(r2), 1e-9)
        theta = np.arctan(r)
        by_coefficient = [xy * (theta**power / r)[:, None] for power in (3, 5, 7, 9)]
    for i in range(len(camera.coefficients)):
        J[:, :, 4 + i] = focal * by_coefficient[i]
    return J


# --- how much an observation counts ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Loss:
    """Hampel's loss of a residual's length s: s² up to a, of constant slope up to b, which falls to 0 at c.

    Huber's with b = c = ∞ (Hampel et al. 1986, section 2.6; Huber 1964).
    """

    a: float
    """Up to here a residual counts in full."""
    b: float
    """Up to here it pulls as much as one of length a."""
    c: float
    """From here on it does not pull."""

    def weight(self, s: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """ψ(s) / s."""
        weight = self.a / np.maximum(s, self.a)
        if np.isfinite(self.c):
            weight *= np.clip((self.c - s) / (self.c - self.b), 0.0, 1.0)
        return np.asarray(weight)

    def cost(self, s: Float[np.ndarray, "m"]) -> float:
        """Σ 2 ρ(s); infinite where a residual is not a number."""
        if not np.isfinite(s).all():
            return float("inf")
        bent = np.minimum(s, self.b)
        cost = np.where(bent <= self.a, bent**2, 2 * self.a * bent - self.a**2)
        if np.isfinite(self.c):
            left = np.clip((self.c - s) / (self.c - self.b), 0.0, 1.0)
            cost += self.a * (self.c - self.b) * (1 - left**2)
        return float(cost.sum())


# --- the search ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """The observations condensed at a state: see kernels/adjustment.py."""

    p_mm: Float[np.ndarray, "s 3"]
    """Place of each sighting in sensor coordinates."""
    A: Float[np.ndarray, "s 3 3"]
    """Information about it."""
    b: Float[np.ndarray, "s 3"]
    """Its pull."""
    C: Float[np.ndarray, "s 3 q"]
    """What it shares with the rig's unknowns."""
    H_rig: Float[np.ndarray, "q q"]
    """Information about these."""
    g_rig: Float[np.ndarray, "q"]
    """Their right-hand side."""


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """A step, and the factors that give the covariances."""

    columns: Float[np.ndarray, "c"]
    """Step of the targets that are unknown, then of the rig."""
    delta: Float[np.ndarray, "f 6"]
    """Step of the poses."""
    decrease: float
    """What the cost should fall by: gᵀ H⁻¹ g."""
    factor: Float[np.ndarray, "c c"]
    """Cholesky factor of the reduced matrix."""
    L: Float[np.ndarray, "f 6 6"]
    """Cholesky factors of the poses' own matrices."""
    F: Float[np.ndarray, "w 6"]
    """What couples the poses to the columns."""


class _Search:
    """Levenberg-Marquardt on reweighted residuals; leaves out what too little holds."""

    def __init__(self, network: _Network, options: AdjustOptions, start: _State):
        from scipy.special import chdtri

        self.network, self.options, self.start, self.state = network, options, start, start
        # as rare for d coordinates as the given number of sigmas is for two
        self.doubt = float(np.sqrt(chdtri(network.measured.shape[1], np.exp(-(options.doubt_sigmas**2) / 2))))
        self.median = float(np.sqrt(chdtri(network.measured.shape[1], 0.5)))
        self.is_frame_in = np.bincount(network.frame, minlength=network.frames) > 0
        self.is_target_in = np.bincount(network.target, minlength=network.targets) > 0
        self.is_active = np.ones(len(network), dtype=bool)
        self.steps = 0

    def run(self, watch: Callable[[], None] | None) -> None:
        """Moves the state to the minimum."""
        r = self.network.residuals(self.state)
        s = np.linalg.norm(r, axis=1)
        self.is_active = np.isfinite(s)  # what lies behind a camera at the start has nothing to say
        if not self.is_active.any():
            raise AdjustmentError("At the poses given, no target lies in front of the camera that saw it.")
        scale, damping, last_sigmas, is_final = np.inf, 0.0, np.inf, False
        while self.steps < self.options.most_steps:
            self.steps += 1
            if watch is not None:
                watch()
            if not is_final:
                scale = max(1.0, min(scale, float(np.median(s[self.is_active])) / self.median))
            loss = self._loss(scale, is_final)
            linear = self._linearise(r, loss.weight(s), bends=is_final)
            cost = self._cost(loss, self.state, s)
            while True:
                solution = self._solve(linear, damping)
                candidate = self._moved(solution)
                r = self.network.residuals(candidate)
                s = np.linalg.norm(r, axis=1)
                if solution.decrease < _NEGLIGIBLE or self._cost(loss, candidate, s) <= cost:
                    break
                damping = max(10 * damping, 1e-3)
                if damping > 1e9:
                    raise AdjustmentError("The adjustment found no way down: the poses given are too far from right.")
            self.state = candidate
            step_sigmas = float(np.sqrt(solution.decrease / self.unknowns))
            is_rounding = last_sigmas / 2 < step_sigmas < _ROUNDED
            if is_final and damping == 0 and (step_sigmas < _SETTLED or is_rounding):
                self.s, weight = s, loss.weight(s)
                self.solution = self._solve(self._linearise(r, weight, bends=False), 0.0)
                self.weight = np.where(self.is_active, weight, 0.0)
                return
            last_sigmas = step_sigmas
            is_final = is_final or solution.decrease <= _NEAR * cost
            damping = damping / 10 if damping > 1e-3 else 0.0
        raise AdjustmentError(f"The adjustment did not settle within {self.options.most_steps} steps.")

    def _loss(self, scale: float, is_final: bool) -> _Loss:
        a = self.doubt * scale
        c = a * self.options.reject_sigmas / self.options.doubt_sigmas
        return _Loss(a, (a + c) / 2, c) if is_final else _Loss(a, np.inf, np.inf)

    def _cost(self, loss: _Loss, state: _State, s: Float[np.ndarray, "m"]) -> float:
        return loss.cost(s[self.is_active]) + self._known_chi2(state)

    # what else is known: places, lengths, the calibration

    def _known_chi2(self, state: _State) -> float:
        network = self.network
        off = network.control_xyz_mm - state.xyz_mm
        off[~self.is_target_in] = 0.0
        chi2 = float(np.einsum("ni,nij,nj->", off, network.control, off))
        for bar in self._bars():
            length = float(np.linalg.norm(state.xyz_mm[bar.first] - state.xyz_mm[bar.second]))
            chi2 += ((length - bar.length_mm) / bar.sigma_mm) ** 2
        if network.rig_unknowns is not None:
            chi2 += float((network.rig_unknowns.calibration(state.rigs[0])[0] ** 2).sum())
        return chi2

    def _bars(self) -> list[ScaleBar]:
        return [bar for bar in self.network.scale_bars if self.is_target_in[[bar.first, bar.second]].all()]

    def _known(self, linear: _Linear) -> tuple[Float[np.ndarray, "c c"], Float[np.ndarray, "c"]]:
        """Normal equations of the columns from these alone, and from the rig's own part of the observations."""
        network, state = self.network, self.state
        S, g = np.zeros((self.size, self.size)), np.zeros(self.size)
        pull = np.einsum("nij,nj->ni", network.control, network.control_xyz_mm - state.xyz_mm)
        for j in np.flatnonzero(network.control.any(axis=(1, 2)) & (self.column >= 0)):
            c = self.column[j]
            S[c : c + 3, c : c + 3] += network.control[j]
            g[c : c + 3] += pull[j]
        for bar in self._bars():
            between = state.xyz_mm[bar.first] - state.xyz_mm[bar.second]
            length = np.linalg.norm(between)
            J, r = between / length / bar.sigma_mm, (bar.length_mm - length) / bar.sigma_mm
            ends = [(self.column[j], sign * J) for j, sign in ((bar.first, 1), (bar.second, -1)) if self.column[j] >= 0]
            for c, J_c in ends:
                g[c : c + 3] += J_c * r
                for d, J_d in ends:
                    S[c : c + 3, d : d + 3] += np.outer(J_c, J_d)
        if network.rig_unknowns is not None:
            q = len(network.rig_unknowns)
            off, J = network.rig_unknowns.calibration(state.rigs[0])
            S[-q:, -q:] += linear.H_rig + J.T @ J
            g[-q:] += linear.g_rig - J.T @ off
        return S, g

    # one step

    def _linearise(self, r: Float[np.ndarray, "m d"], weight: Float[np.ndarray, "m"], *, bends: bool) -> _Linear:
        """Condenses the observations; frames and targets that they do not hold firmly leave the search.

        With ``bends``, the loss's own curvature counts, as in Newton's method: beyond a, a loss of constant slope has
        none along the residual (Triggs et al. 2000, section 4.3). A little stays, so that the matrix is positive.
        """
        network, state = self.network, self.state
        p = network.in_sensor_mm(state)
        J, J_rig = network.jacobians(state, p)
        n, q = len(p), J_rig.shape[2]
        A, b, C = np.empty((n, 3, 3)), np.empty((n, 3)), np.zeros((n, 3, q))
        distance = np.linalg.norm(p, axis=1)
        while True:
            used = np.where(self.is_active, weight, 0.0)
            kernels.condense(network.observation_start, J, r, used, A, b)
            of_pose, of_target = np.zeros((network.frames, 6, 6)), network.control.copy()
            kernels.own_information(network.start, network.target, p, A, state.R, of_pose, of_target)
            in_mm = np.ones((network.frames, 6))
            in_mm[:, :3] = _mean_by(network.frame, distance, network.frames)[:, None]
            of_pose *= in_mm[:, :, None] * in_mm[:, None, :]
            of_target *= _mean_by(network.target, distance, network.targets)[:, None, None] ** 2
            least = self.options.least_firmness**2
            is_frame_in = self.is_frame_in & (np.linalg.eigvalsh(of_pose)[:, 0] >= least)
            is_target_in = self.is_target_in & ((np.linalg.eigvalsh(of_target)[:, 0] >= least) | network.is_held)
            if network.fixed is not None:
                is_frame_in[network.fixed] = True
            is_same = (is_frame_in == self.is_frame_in).all() and (is_target_in == self.is_target_in).all()
            self.is_frame_in, self.is_target_in = is_frame_in, is_target_in
            if is_same:
                break
            is_sighting_in = is_frame_in[network.frame] & is_target_in[network.target]
            self.is_active &= is_sighting_in[network.sighting]
        self._number()
        if bends:
            doubted = np.flatnonzero((used > 0) & (used < 1))
            along = r[doubted] / np.linalg.norm(r[doubted], axis=1, keepdims=True)
            shrink = np.eye(r.shape[1]) - (1 - np.sqrt(_RADIAL)) * along[:, :, None] * along[:, None, :]
            J, J_rig, r = J.copy(), J_rig.copy(), r.copy()
            J[doubted], J_rig[doubted] = shrink @ J[doubted], shrink @ J_rig[doubted]
            r[doubted] /= np.sqrt(_RADIAL)  # so that Jᵀ r stays
            kernels.condense(network.observation_start, J, r, used, A, b)
        H_rig, g_rig = np.zeros((q, q)), np.zeros(q)
        if q:
            kernels.condense_rig(network.observation_start, J, J_rig, r, used, C, H_rig, g_rig)
        return _Linear(p, A, b, C, H_rig, g_rig)

    def _number(self) -> None:
        """Numbers the unknowns that are left."""
        network = self.network
        q = 0 if network.rig_unknowns is None else len(network.rig_unknowns)
        is_unknown = self.is_target_in & ~network.is_held
        self.column = np.where(is_unknown, 3 * (np.cumsum(is_unknown) - 1), -1)
        self.size = 3 * int(is_unknown.sum()) + q
        self.is_free = self.is_frame_in.copy()
        if network.fixed is not None:
            self.is_free[network.fixed] = False
        self.unknowns = 6 * int(self.is_free.sum()) + self.size
        if not self.unknowns:
            raise AdjustmentError("There is nothing to adjust: no frame saw enough targets to hold its pose.")
        # the columns that each pose is coupled to: three a sighting, then the rig's
        first = self.column[network.target][:, None]
        self.columns = np.full(3 * len(network.target) + q * network.frames, -1)
        at = 3 * np.arange(len(network.target)) + q * network.frame
        self.columns[at[:, None] + [0, 1, 2]] = np.where(first >= 0, first + [0, 1, 2], -1)
        if q:
            at = 3 * network.start[1:] + q * np.arange(network.frames)
            self.columns[at[:, None] + np.arange(q)] = self.size - q + np.arange(q)

    def _solve(self, linear: _Linear, damping: float) -> _Solution:
        from scipy.linalg import lapack

        network = self.network
        S, g = self._known(linear)
        own = np.zeros(self.size)
        L, y = np.zeros((network.frames, 6, 6)), np.zeros((network.frames, 6))
        F, delta = np.zeros((len(self.columns), 6)), np.zeros((network.frames, 6))
        layout = network.start, network.target, self.column, self.is_free
        sightings = linear.p_mm, linear.A, linear.b, linear.C, self.state.R
        kernels.eliminate(*layout, *sightings, damping, S, g, own, L, F, y, self.columns)
        columns, factor = g, S
        if self.size:
            factor, failed = lapack.dpotrf(S.T, lower=1, clean=0, overwrite_a=1)
            loose = failed - 1 if failed else int(np.argmin(np.diag(factor) ** 2 / own))
            if failed or factor[loose, loose] ** 2 < _LEAST_PIVOT * own[loose]:
                raise AdjustmentError(self._untied(loose))
            columns, _ = lapack.dpotrs(factor, g, lower=1)
        kernels.substitute(network.start, self.is_free, columns, L, F, y, self.columns, delta)
        return _Solution(columns, delta, float((y**2).sum() + g @ columns), factor, L, F)

    def _untied(self, column: int) -> str:
        target = np.flatnonzero((self.column >= 0) & (self.column <= column))
        gauge = "the known targets" if self.network.fixed is None else f"frame {self.network.fixed}"
        if not len(target) or column >= self.column[target[-1]] + 3:
            return "The rig cannot be refined: what was seen does not determine it."
        return (
            f"Target {target[-1]} is not tied to {gauge}: no chain of frames leads there in which each has three "
            "targets in common with those before it; leave it and the frames around it out."
        )

    def _moved(self, solution: _Solution) -> _State:
        state, unknowns = self.state, self.network.rig_unknowns
        R, t, xyz = state.R.copy(), state.t_mm.copy(), state.xyz_mm.copy()
        kernels.move(R, t, solution.delta)
        is_unknown = self.column >= 0
        count = 3 * int(is_unknown.sum())
        xyz[is_unknown] += solution.columns[:count].reshape(-1, 3)
        rigs = state.rigs if unknowns is None else (unknowns.moved(state.rigs[0], solution.columns[count:]),)
        return _State(R, t, xyz, rigs)

    # what came out

    def result(self, given: Sequence[Pose]) -> Adjustment:
        """The state that ``run`` reached, with its covariances."""
        from scipy.linalg import lapack

        network, state, solution = self.network, self.state, self.solution
        cov = np.zeros((0, 0))
        if self.size:
            cov = lapack.dpotri(solution.factor, lower=1, overwrite_c=1)[0].T
            kernels.mirror(cov)
        pose_cov = np.zeros((network.frames, 6, 6))
        kernels.pose_covariances(network.start, self.is_free, cov, solution.L, solution.F, self.columns, pose_cov)
        pose_cov[~self.is_frame_in] = np.nan
        count = 3 * int((self.column >= 0).sum())
        q = self.size - count
        map_cov = cov[:count, :count]
        if count < 3 * network.targets:
            rows = np.repeat(self.column >= 0, 3).nonzero()[0]
            whole = np.zeros((3 * network.targets, 3 * network.targets))
            whole[np.ix_(rows, rows)] = map_cov
            out = np.repeat(~self.is_target_in, 3)
            whole[out] = whole[:, out] = np.nan
            map_cov = whole
        used = self.weight > 0
        dims = network.measured.shape[1]
        known = 3 * int((network.control.any(axis=(1, 2)) & self.is_target_in).sum()) + len(self._bars()) + q
        weight = np.empty(len(network))
        weight[network.order] = self.weight
        return Adjustment(
            T_world_sensor=tuple(
                Pose(R, t) if is_free else T
                for R, t, is_free, T in zip(state.R, state.t_mm, self.is_free, given, strict=True)
            ),
            pose_cov=pose_cov,
            is_frame_adjusted=self.is_frame_in,
            xyz_mm=np.where(self.is_target_in[:, None], state.xyz_mm, self.start.xyz_mm),
            map_cov_mm2=map_cov,
            is_target_adjusted=self.is_target_in,
            rig=None if network.rig_unknowns is None else state.rigs[0],
            rig_parameters=() if network.rig_unknowns is None else network.rig_unknowns.names,
            rig_change=np.zeros(0) if network.rig_unknowns is None else network.rig_unknowns.change(state.rigs[0]),
            rig_cov=cov[count:, count:],
            weight=weight,
            chi2=float((self.weight * np.where(used, self.s, 0.0) ** 2).sum()) + self._known_chi2(state),
            dof=dims * int(used.sum()) + known - self.unknowns,
            steps=self.steps,
        )


def _mean_by(row: Int[np.ndarray, "s"], value: Float[np.ndarray, "s"], rows: int) -> Float[np.ndarray, "r"]:
    """The mean value of each row, 0 where there is none."""
    return np.asarray(np.bincount(row, value, rows) / np.maximum(np.bincount(row, minlength=rows), 1))
