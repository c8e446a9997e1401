"""The truth behind a simulated recording, counted on what was seen and never on what a program makes of it.

Writes the truth folder that formats.md describes. Knows neither images nor points.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.files.tables import fixed, write_table
from trifix.files.trajectories import tum_row
from trifix.files.truth import TrueFrames, TrueTargets
from trifix.geometry.camera import StereoRig
from trifix.geometry.pose import skew
from trifix.sources.scenes import Scene
from trifix.sources.sensing import Sightings

_MM_PER_M = 1000.0
_LEAST_ACROSS_MM = 3.0  # rms; less, and targets stand on one line


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTruth:
    """What happened, for each of n frames and k targets."""

    frames: TrueFrames
    """What formats.md asks of each frame, the poses among it."""
    targets: TrueTargets
    """The targets; their rows are their identities."""
    seen_left: Bool[np.ndarray, "n k"]
    """Which targets have a dot in the left image."""
    seen_right: Bool[np.ndarray, "n k"]
    """Which targets have a dot in the right image."""
    seen_both: Bool[np.ndarray, "n k"]
    """Which targets are seen as a point."""
    label: Int[np.ndarray, "r"]
    """Target of each row of dots.csv or points.csv, -1 for none; without rows where the recording holds images."""
    label_frame: Int[np.ndarray, "r"]
    """Frame of each of these rows."""


def truth_of(
    scene: Scene,
    timestamp_ns: Int[np.ndarray, "n"],
    seen: tuple[Sightings, Sightings],
    seen_both: Bool[np.ndarray, "n k"],
    label: Int[np.ndarray, "r"],
    label_frame: Int[np.ndarray, "r"],
) -> SimulatedTruth:
    """The truth of a scene of which the two cameras have ``seen`` these dots, and both together those points."""
    n, at = len(timestamp_ns), scene.targets
    seen_left, seen_right = (matrix_of(one, n, len(at)) for one in seen)
    known = seen_both & (np.cumsum(seen_both, axis=0) - seen_both >= 2)
    sigma = _pose_sigmas(scene, seen, seen_both)
    frames = TrueFrames(
        index=np.arange(n),
        timestamp_ns=timestamp_ns,
        T_map_sensor=tuple(scene.T_map_sensor),
        visible_left=seen_left.sum(axis=1),
        visible_right=seen_right.sum(axis=1),
        visible_both=seen_both.sum(axis=1),
        known_both=known.sum(axis=1),
        positionable=np.array([spans(at.xyz_mm[row]) for row in known], dtype=bool),
        reachable_online=_reachable_online(seen_both, at.xyz_mm),
        reachable_offline=_reachable_offline(seen_both, at.xyz_mm),
        kidnapped=np.isin(np.arange(n), list(scene.kidnapped)),
        blank=~(seen_left | seen_right).any(axis=1),
        sigma_position_mm=sigma[:, 0],
        sigma_rotation_rad=sigma[:, 1],
    )
    targets = TrueTargets(
        id=np.arange(len(at)),
        xyz_mm=at.xyz_mm,
        normal=at.normal,
        valid_from=at.valid_from,
        valid_to=at.valid_to,
        frames_seen_both=seen_both.sum(axis=0),
    )
    return SimulatedTruth(frames, targets, seen_left, seen_right, seen_both, label, label_frame)


def matrix_of(seen: Sightings, n: int, k: int) -> Bool[np.ndarray, "n k"]:
    """Which of k targets are seen in each of n frames."""
    matrix = np.zeros((n, k), dtype=bool)
    matrix[seen.frame, seen.target] = True
    return matrix


def spans(xyz_mm: Float[np.ndarray, "m 3"]) -> bool:
    """Whether there are three points or more that do not stand on one line."""
    if len(xyz_mm) < 3:
        return False
    scatter = np.linalg.svd(xyz_mm - xyz_mm.mean(axis=0), compute_uv=False)
    return bool(np.sqrt((scatter[1:] ** 2).sum() / len(xyz_mm)) >= _LEAST_ACROSS_MM)


def _reachable_online(seen: Bool[np.ndarray, "n k"], xyz_mm: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "n"]:
    """The map is the first frame that spans, then everything in the frames that share a span with it."""
    reached = np.zeros(len(seen), dtype=bool)
    mapped = np.zeros(len(xyz_mm), dtype=bool)
    for k, row in enumerate(seen):
        shared = row & mapped if mapped.any() else row
        if spans(xyz_mm[shared]):
            reached[k] = True
            mapped |= row
    return reached


def _reachable_offline(seen: Bool[np.ndarray, "n k"], xyz_mm: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, "n"]:
    """The same from every start and in any order; the set that holds most frames."""
    left = np.array([spans(xyz_mm[row]) for row in seen], dtype=bool)
    best = np.zeros(len(seen), dtype=bool)
    while left.sum() > best.sum():
        start = int(np.argmax(left))
        reached, mapped, grows = np.zeros(len(seen), dtype=bool), seen[start].copy(), True
        while grows:
            near = np.nonzero(~reached & ((seen & mapped).sum(axis=1) >= 3))[0]
            new = [k for k in near if spans(xyz_mm[seen[k] & mapped])]
            reached[new] = True
            mapped |= seen[new].any(axis=0)
            grows = bool(new)
        left &= ~reached
        if reached.sum() > best.sum():
            best = reached
    return best


def _pose_sigmas(
    scene: Scene, seen: tuple[Sightings, Sightings], seen_both: Bool[np.ndarray, "n k"]
) -> Float[np.ndarray, "n 2"]:
    """Expected error of the position (mm) and rotation (rad) of every frame."""
    xyz = scene.targets.xyz_mm
    sigma = np.full((len(seen_both), 2), np.nan)
    for k, row in enumerate(seen_both):
        if not spans(xyz[row]):
            continue
        information = np.zeros((6, 6))
        for side, one in enumerate(seen):
            rows = one.of_frame(k)
            in_sensor = scene.T_map_sensor[k].inverse().apply(xyz[one.target[rows]])
            information += _information(scene.rig, side, in_sensor, one.sigma_px[rows])
        cov = np.linalg.inv(information)
        sigma[k] = np.sqrt(np.trace(cov[:3, :3])), np.sqrt(np.trace(cov[3:, 3:]))
    return sigma


def _information(
    rig: StereoRig, side: int, in_sensor_mm: Float[np.ndarray, "m 3"], sigma_px: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "6 6"]:
    """Fisher information of δ, T · exp(δ), in the dots of one camera: Σ Jᵀ J / σ² with J = dπ/dp · [−I, [p]×]."""
    if side == 0:
        J_point = rig.left.project_jacobian(in_sensor_mm)
    else:
        J_point = rig.right.project_jacobian(rig.T_right_left.apply(in_sensor_mm)) @ rig.T_right_left.R
    turn = np.array([skew(p) for p in in_sensor_mm]).reshape(-1, 3, 3)
    J = np.concatenate([-J_point, J_point @ turn], axis=2) / sigma_px[:, None, None]
    return np.asarray(np.einsum("mai,maj->ij", J, J))


# --- files ---------------------------------------------------------------------------------------------------------


def write_truth(truth: SimulatedTruth, folder: Path, labels: str | None) -> None:
    """Writes into the truth folder; ``labels`` is the table that the labels belong to, dots or points, or None."""
    frames, targets = truth.frames, truth.targets
    header = "# timestamp_s tx ty tz qx qy qz qw (left camera in map coordinates, metres)"
    rows = [tum_row(t, pose) for t, pose in zip(frames.timestamp_ns.tolist(), frames.T_map_sensor, strict=True)]
    (folder / "trajectory.tum").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    xyz_m = targets.xyz_mm / _MM_PER_M
    write_table(
        folder / "map.csv",
        {"id": _whole(targets.id)}
        | {name: [fixed(x, 9) for x in xyz_m[:, i].tolist()] for i, name in enumerate(("x", "y", "z"))}
        | {name: [fixed(x) for x in targets.normal[:, i].tolist()] for i, name in enumerate(("nx", "ny", "nz"))}
        | {"valid_from": _whole(targets.valid_from), "valid_to": _whole(targets.valid_to)}
        | {"frames_seen_both": _whole(targets.frames_seen_both)},
    )
    if labels is not None:
        columns = {"row": np.arange(len(truth.label)), "frame": truth.label_frame, "id": truth.label}
        write_table(folder / f"labels_{labels}.csv", {name: _whole(column) for name, column in columns.items()})
    counts = {
        "frame": frames.index,
        "timestamp_ns": frames.timestamp_ns,
        "n_visible_cam0": frames.visible_left,
        "n_visible_cam1": frames.visible_right,
        "n_visible_both": frames.visible_both,
        "n_known_both": frames.known_both,
        "positionable": frames.positionable,
        "reachable_online": frames.reachable_online,
        "reachable_offline": frames.reachable_offline,
        "kidnapped": frames.kidnapped,
        "blank": frames.blank,
    }
    sigmas = {"sigma_pos_mm": frames.sigma_position_mm, "sigma_rot_deg": np.degrees(frames.sigma_rotation_rad)}
    write_table(
        folder / "frames_truth.csv",
        {name: _whole(column) for name, column in counts.items()}
        | {name: [fixed(x) for x in column.tolist()] for name, column in sigmas.items()},
    )


def _whole(numbers: Int[np.ndarray, "n"] | Bool[np.ndarray, "n"]) -> list[str]:
    return [str(int(x)) for x in numbers]
