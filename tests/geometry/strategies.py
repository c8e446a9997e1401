"""Poses and cameras drawn at random, near-degenerate ones included."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose

LAW = settings(max_examples=60, deadline=None, derandomize=True)
"""How every law is tried: the same bounded set of examples each time."""

_UNIT = st.floats(-1.0, 1.0, allow_nan=False)
_ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-8, 9.9e-5, 1.01e-4, 1e-3, np.pi / 2, np.pi - 1e-3, np.pi - 1e-8, np.pi - 1e-12]),
    st.floats(0.0, np.pi - 1e-6),
)


@st.composite
def directions(draw: st.DrawFn) -> np.ndarray:
    v = np.array([draw(_UNIT) for _ in range(3)])
    n = float(np.linalg.norm(v))
    return v / n if n > 1e-3 else np.array([0.0, 0.0, 1.0])


@st.composite
def tangents(draw: st.DrawFn, length_mm: float = 1000.0) -> np.ndarray:
    """δ = (translation mm, rotation rad) with angles from 0 to just below π."""
    rho = length_mm * np.array([draw(_UNIT) for _ in range(3)])
    return np.concatenate([rho, draw(_ANGLES) * draw(directions())])


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    return Pose.exp(draw(tangents()))


PINHOLE = Camera(900.0, 905.0, 633.5, 511.0, 1280, 1024)
RADTAN4 = Camera(900.0, 905.0, 633.5, 511.0, 1280, 1024, "radtan", (-0.21, 0.09, 0.0007, -0.0011))
RADTAN5 = Camera(900.0, 905.0, 633.5, 511.0, 1280, 1024, "radtan", (-0.21, 0.09, 0.0007, -0.0011, -0.02))
FISHEYE = Camera(420.0, 421.0, 633.5, 511.0, 1280, 1024, "equidistant", (0.03, -0.012, 0.006, -0.002))
CAMERAS = {"none": PINHOLE, "radtan4": RADTAN4, "radtan5": RADTAN5, "equidistant": FISHEYE}

CONVERGENT = StereoRig(RADTAN5, RADTAN4, Pose.exp(np.array([-120.0, 3.0, 14.0, 0.01, 0.25, -0.02])))
PARALLEL = StereoRig(PINHOLE, PINHOLE, Pose(np.eye(3), np.array([-120.0, 0.0, 0.0])))
RIGS = {"convergent": CONVERGENT, "parallel": PARALLEL}


def points_before(rng: np.random.Generator, n: int) -> np.ndarray:
    """Points (mm) in front of a sensor, 250 to 800 mm away."""
    z = rng.uniform(250.0, 800.0, n)
    return np.c_[rng.uniform(-0.35, 0.35, (n, 2)) * z[:, None], z]
