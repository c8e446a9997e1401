"""Identifications -> poses: weighted absolute orientation of the paired points (the paper's part P8).

Knows neither how the pairs were found nor whether they are right.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from trifix.geometry.alignment import align_weighted, point_jacobian
from trifix.geometry.pose import Pose
from trifix.kernels import positioning as kernels
from trifix.records import Identification, Orientations, Prediction, ReferenceMap, SensorPoints

_NONE = (np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 6, 6)))


def orient(
    points: SensorPoints, map: ReferenceMap, identification: Identification, prediction: Prediction | None = None
) -> Orientations:
    """``T_world_sensor`` of every hypothesis, with its covariance, from the pairs of that hypothesis alone.

    One that names no pairs supposes that the sensor is where its motion leads; one or two pairs correct that.
    """
    h, c = identification.point.shape
    if c < 3:
        assert prediction is not None, "only a predicted pose needs fewer than three pairs"
        predicted = [_corrected(prediction, points, map, *pairs) for pairs in _rows(identification)]
        R, t, cov = (np.stack(each) for each in zip(*predicted, strict=True)) if h else _NONE
        return Orientations(R, t, cov, np.ones(h, dtype=np.bool_), np.zeros(h))
    if c == 3:
        return Orientations(
            *kernels.orient_triangles(
                points.xyz_mm,
                points.cov_mm2,
                identification.point,
                map.xyz_mm,
                map.cov_mm2,
                identification.target,
            )
        )
    R, t, cov, is_valid = np.zeros((h, 3, 3)), np.zeros((h, 3)), np.zeros((h, 6, 6)), np.zeros(h, dtype=np.bool_)
    for row, (p, q) in enumerate(zip(identification.point, identification.target, strict=True)):
        try:
            T, cov[row] = align_weighted(points.xyz_mm[p], map.xyz_mm[q], points.cov_mm2[p], map.cov_mm2[q])
        except np.linalg.LinAlgError:
            continue
        R[row], t[row], is_valid[row] = T.R, T.t_mm, True
    return Orientations(R, t, cov, is_valid, np.full(h, np.nan))


def _rows(identification: Identification) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    return zip(identification.point, identification.target, strict=True)


def _corrected(
    prediction: Prediction,
    points: SensorPoints,
    map: ReferenceMap,
    point: Int[np.ndarray, "c"],
    target: Int[np.ndarray, "c"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The predicted pose, as rotation, translation and covariance, after a Kalman update by each pair."""
    T, P = prediction.T_world_sensor, prediction.cov
    for p, q in zip(point, target, strict=True):
        J = point_jacobian(points.xyz_mm[p : p + 1])[0]
        r = T.inverse().apply(map.xyz_mm[q : q + 1])[0] - points.xyz_mm[p]
        S = J @ P @ J.T + points.cov_mm2[p] + T.R.T @ map.cov_mm2[q] @ T.R
        K = np.linalg.solve(S, J @ P).T
        T, P = T @ Pose.exp(K @ r), P - K @ J @ P
    return T.R, T.t_mm, 0.5 * (P + P.T)
