"""How well each position is known, and a point that the sensor sees half a metre ahead, in millimetres."""

import numpy as np

from trifix import Fix, position
from trifix.geometry.pose import skew

ahead_mm = np.array([0.0, 0.0, 500.0])  # sensor coordinates
found = position("demo/recording")
for frame, fix in zip(found.frame, found.fixes, strict=True):
    if isinstance(fix, Fix):
        position_mm = np.sqrt(np.trace(fix.cov[:3, :3]))
        J = np.hstack([np.eye(3), -skew(ahead_mm)])  # moves with δ = (translation, rotation), as in the conventions
        point_mm = np.sqrt(np.trace(J @ fix.cov @ J.T))
        print(frame, f"position {position_mm:.3f} mm, ahead {point_mm:.3f} mm")
