"""Identifications -> poses: weighted absolute orientation of the paired points (the paper's part P8).

Knows neither how the pairs were found nor whether they are right.
"""

import numpy as np

from trifix.geometry.alignment import align_weighted
from trifix.kernels import positioning as kernels
from trifix.records import Identification, Orientations, Prediction, ReferenceMap, SensorPoints


def orient(
    points: SensorPoints, map: ReferenceMap, identification: Identification, prediction: Prediction | None = None
) -> Orientations:
    """``T_world_sensor`` of every hypothesis, with its covariance, from the pairs of that hypothesis alone.

    One that names no pairs supposes that the sensor is where its motion leads.
    """
    h, c = identification.point.shape
    if c == 0:
        assert prediction is not None, "only a predicted pose needs no pairs"
        T = prediction.T_world_sensor
        return Orientations(T.R[None], T.t_mm[None], prediction.cov[None], np.ones(1, dtype=np.bool_), np.zeros(1))
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
