"""What the cameras make of a scene: which targets they see, where, and as which dots and points.

Positions come from geometry alone (``Camera.project``, ray casting); chance enters with noise, dropout and ghosts.
Nothing here is shared with the stages that the simulator is there to test.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.epipolar import essential_matrix, pairs_near_epipolar_lines
from trifix.geometry.pose import Pose
from trifix.geometry.triangulation import triangulate
from trifix.records import Dots, SensorPoints, StereoDots
from trifix.sources.scenes import Scene, Sensing

_RIM = 24
"""Points by which the rim of a target is drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The targets that one camera sees, free of noise: one row for each frame and target, by frame."""

    frame: Int[np.ndarray, "s"]
    """Number of the frame."""
    target: Int[np.ndarray, "s"]
    """Row of the target."""
    uv_px: Float[np.ndarray, "s 2"]
    """Centre of the image of the circle, which is not the image of the centre."""
    shift_px: Float[np.ndarray, "s 2"]
    """From there to the image of the centre."""
    root_px: Float[np.ndarray, "s 2 2"]
    """The image's shape: the symmetric matrix that makes it of the unit circle."""
    sigma_px: Float[np.ndarray, "s"]
    """Standard deviation that the dot would have, per axis."""

    def of_frame(self, k: int) -> slice:
        """The rows of one frame."""
        first, last = np.searchsorted(self.frame, [k, k + 1])
        return slice(int(first), int(last))

    def where(self, kept: Bool[np.ndarray, "s"]) -> "Sightings":
        """Those of a mask."""
        return Sightings(*(getattr(self, each.name)[kept] for each in fields(self)))

    @property
    def diameter_px(self) -> Float[np.ndarray, "s"]:
        """Diameter of the circle of the same area."""
        return np.asarray(2 * np.sqrt(np.linalg.det(self.root_px)))


def camera_poses(scene: Scene, side: int) -> list[Pose]:
    """T_camera_map of the left (0) or right (1) camera in every frame."""
    if side == 0:
        return [pose.inverse() for pose in scene.T_map_sensor]
    return [scene.rig.T_right_left @ pose.inverse() for pose in scene.T_map_sensor]


def sightings(scene: Scene, side: int) -> Sightings:
    """What the left (0) or right (1) camera sees: in the image, in range, not too oblique, not hidden, and there."""
    camera = scene.rig.left if side == 0 else scene.rig.right
    targets, sensing = scene.targets, scene.sensing
    poses = camera_poses(scene, side)
    R = np.stack([pose.R for pose in poses])
    t = np.stack([pose.t_mm for pose in poses])
    centre = -np.einsum("nji,nj->ni", R, t)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    for first in range(0, len(R), 256):  # in portions, for the memory's sake
        part = slice(first, first + 256)
        to_camera = centre[part, None] - targets.xyz_mm
        cosine = np.einsum("nki,ki->nk", to_camera, targets.normal) / np.linalg.norm(to_camera, axis=2)
        z = -np.einsum("ni,nki->nk", R[part, 2], to_camera)
        number = np.arange(first, first + len(z))[:, None]
        maybe = (
            (cosine > np.cos(np.radians(sensing.max_incidence_deg)))
            & (z > sensing.depth_mm[0])
            & (z < sensing.depth_mm[1])
            & (number >= targets.valid_from)
            & (number < targets.valid_to)
        )
        n, k = np.nonzero(maybe)
        inside = camera.sees(-np.einsum("nij,nj->ni", R[part][n], to_camera[n, k]))
        kept.append((n[inside] + first, k[inside]))
    frame, target = (np.concatenate(column) for column in zip(*kept, strict=True))
    free = ~scene.surface.hides(centre[frame], targets.xyz_mm[target])
    frame, target = frame[free], target[free]

    uv, root, extent = _images_of_circles(
        camera, R[frame], t[frame], targets.xyz_mm[target], targets.normal[target], scene.diameter_mm
    )
    size = np.array([camera.width_px, camera.height_px])
    whole = ((uv - extent > 0) & (uv + extent < size - 1)).all(axis=1)
    to_camera = centre[frame] - targets.xyz_mm[target]
    cosine = np.einsum("si,si->s", to_camera, targets.normal[target]) / np.linalg.norm(to_camera, axis=1)
    centres = camera.project(np.einsum("sij,sj->si", R[frame], targets.xyz_mm[target]) + t[frame])
    return Sightings(frame, target, uv, centres - uv, root, sensing.sigma_px / cosine).where(whole)


def dots_of_frame(
    scene: Scene, seen: tuple[Sightings, Sightings], k: int, rng: np.random.Generator, first_row: int
) -> tuple[StereoDots, Int[np.ndarray, "d"]]:
    """The dots of frame k and the target of each, -1 for ghosts; rows number both images' dots together, shuffled."""
    sensing = scene.sensing
    columns = []
    for side, camera in enumerate((scene.rig.left, scene.rig.right)):
        rows = seen[side].of_frame(k)
        target, sigma = seen[side].target[rows], seen[side].sigma_px[rows]
        uv = seen[side].uv_px[rows] + sigma[:, None] * rng.standard_normal((len(target), 2))
        size, oval = rng.standard_normal(len(target)), rng.spawn(1)[0].standard_normal((len(target), 2))
        ellipse = _ellipses(seen[side].root_px[rows] + sigma[:, None, None] * _shape_errors(size, oval))
        found = rng.random(len(target)) >= sensing.dropout
        ghosts = rng.poisson(sensing.ghosts_per_image + sensing.ghosts_per_dot * len(target))
        columns.append(
            (
                np.full(found.sum() + ghosts, side),
                np.concatenate([uv[found], rng.uniform(0, 1, (ghosts, 2)) * [camera.width_px, camera.height_px] - 0.5]),
                np.concatenate([ellipse[found], _ghosts(ghosts, rng)]),
                np.concatenate([sigma[found], np.full(ghosts, sensing.sigma_px)]),
                np.concatenate([target[found], np.full(ghosts, -1)]),
            )
        )
    side_of, uv, ellipse, sigma, label = (np.concatenate(column) for column in zip(*columns, strict=True))
    order = rng.permutation(len(label))
    side_of, uv, ellipse, sigma, label = side_of[order], uv[order], ellipse[order], sigma[order], label[order]

    def dots(side: int) -> Dots:
        row = np.nonzero(side_of == side)[0]
        return Dots(
            uv_px=uv[row],
            cov_px2=sigma[row, None, None] ** 2 * np.eye(2),
            ellipse=ellipse[row],
            label=np.full(len(row), -1),
            row=first_row + row,
        )

    return StereoDots(dots(0), dots(1)), label


def _shape_errors(size: Float[np.ndarray, "n"], oval: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 2"]:
    """Errors of a shape whose edge errs independently all round, where those of the centre are one along each axis.

    As harmonics of the angle: the centre has both of the first, the mean radius half of their variance, and the two
    ways of being oval as much as they.
    """
    mean, along, across = size / np.sqrt(2), oval[:, 0], oval[:, 1]
    return np.stack([np.stack([mean + along, across], axis=1), np.stack([across, mean - along], axis=1)], axis=1)


def _ellipses(root_px: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "n 3"]:
    """Semi-axes and angle of shapes; however small the dot, there is something of it."""
    value, vector = np.linalg.eigh(root_px)
    axes = np.maximum(value[:, ::-1], 0.5)
    return np.column_stack([axes, np.arctan2(vector[:, 1, 1], vector[:, 0, 1])])


def _ghosts(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Shapes of dots that are no target."""
    radius = 0.5 * rng.uniform(5, 30, n)
    rng = rng.spawn(1)[0]
    ratio = rng.uniform(0.4, 1.0, n)
    return np.column_stack([radius / np.sqrt(ratio), radius * np.sqrt(ratio), rng.uniform(0, np.pi, n)])


def with_centres(
    dots: StereoDots,
    labels: tuple[Int[np.ndarray, "l"], Int[np.ndarray, "r"]],
    seen: tuple[Sightings, Sightings],
    k: int,
) -> StereoDots:
    """The dots of frame k with the images of the targets' centres, as a sensor has them that delivers points."""

    def moved(own: Dots, label: Int[np.ndarray, "d"], by: Sightings) -> Dots:
        rows = by.of_frame(k)
        shift_px = np.zeros((1 + label.max(initial=-1) + 1, 2))  # the last row: ghosts
        known = by.target[rows] < len(shift_px) - 1
        shift_px[by.target[rows][known]] = by.shift_px[rows][known]
        return replace(own, uv_px=own.uv_px + shift_px[label])

    return StereoDots(moved(dots.left, labels[0], seen[0]), moved(dots.right, labels[1], seen[1]))


def points_of_frame(
    rig: StereoRig,
    sensing: Sensing,
    dots: StereoDots,
    left_label: Int[np.ndarray, "l"],
    right_label: Int[np.ndarray, "r"],
    rng: np.random.Generator,
    first_row: int,
) -> tuple[SensorPoints, Int[np.ndarray, "p"]]:
    """All pairs of dots near one another's epipolar line and in range, as points, and the target of each.

    Where several dots lie on one epipolar line, false pairs arise as they do before a real sensor; their label is -1.
    """
    xy_left, xy_right = rig.left.unproject(dots.left.uv_px), rig.right.unproject(dots.right.uv_px)
    gate = sensing.epipolar_gate_px / rig.right.fu_px
    left, right = pairs_near_epipolar_lines(essential_matrix(rig), xy_left, xy_right, gate)
    xyz, cov = triangulate(
        rig,
        xy_left[left],
        xy_right[right],
        _slope_covariance(rig.left, xy_left, dots.left)[left],
        _slope_covariance(rig.right, xy_right, dots.right)[right],
    )
    depth = np.stack([xyz[:, 2], rig.T_right_left.apply(xyz)[:, 2]])
    near, far = sensing.depth_mm
    with np.errstate(invalid="ignore"):
        order = np.nonzero(((depth > near) & (depth < far)).all(axis=0))[0]
    order = rng.permutation(order)
    label = np.where(left_label[left] == right_label[right], left_label[left], -1)[order]
    n = len(order)
    points = SensorPoints(
        xyz_mm=xyz[order],
        cov_mm2=cov[order],
        match=np.full(n, -1),
        label=np.full(n, -1),
        row=first_row + np.arange(n),
    )
    return points, label


def _slope_covariance(camera: Camera, xy: Float[np.ndarray, "n 2"], dots: Dots) -> Float[np.ndarray, "n 2 2"]:
    J = camera.unproject_jacobian(xy)
    return np.asarray(J @ dots.cov_px2 @ np.swapaxes(J, 1, 2))


def circle_rim(
    centre_mm: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"], diameter_mm: float
) -> Float[np.ndarray, "n r 3"]:
    """Points on the rims of circles, evenly round each."""
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    a = np.cross(normal, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normal, a)
    angle = 2 * np.pi * np.arange(_RIM) / _RIM
    offset = np.cos(angle)[:, None] * a[:, None] + np.sin(angle)[:, None] * b[:, None]
    return np.asarray(centre_mm[:, None] + 0.5 * diameter_mm * offset)


def _images_of_circles(
    camera: Camera,
    R: Float[np.ndarray, "n 3 3"],
    t: Float[np.ndarray, "n 3"],
    centre_mm: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    diameter_mm: float,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n 2"]]:
    """Centre of area, shape as in ``Sightings``, and half extent along u and v (px) of circles seen by a camera.

    The rim is projected point by point, so perspective and distortion are both exact; the integrals are taken along the
    smooth curve through its points. Those have half of the shape's square as their second moments.
    """
    rim = circle_rim(centre_mm, normal, diameter_mm)
    in_camera = np.einsum("nij,nrj->nri", R, rim) + t[:, None]
    uv = camera.project(in_camera.reshape(-1, 3)).reshape(len(R), _RIM, 2)
    around = uv - uv.mean(axis=1, keepdims=True)
    wave = 1j * np.arange(_RIM // 2 + 1)
    ahead = np.fft.irfft(wave[:, None] * np.fft.rfft(around, axis=1), _RIM, axis=1)
    cross = around[:, :, 0] * ahead[:, :, 1] - around[:, :, 1] * ahead[:, :, 0]
    centre = 2 * (around * cross[:, :, None]).sum(axis=1) / (3 * cross.sum(axis=1)[:, None])
    value, vector = np.linalg.eigh(np.einsum("nri,nrj->nij", around, around) * (2 / _RIM))
    root = (vector * np.sqrt(value)[:, None]) @ np.swapaxes(vector, 1, 2)
    return np.asarray(centre + uv.mean(axis=1)), np.asarray(root), np.asarray(np.ptp(uv, axis=1) / 2)
