"""Shapes and colours of what the viewer shows in space: targets, their uncertainty, the path. Arrays only; no page.

Colours are told apart by all kinds of eyes, on light and on dark ground, and never say alone what a shape says too.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8

from trifix.records import TargetState

Mesh = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]
"""Vertices, and the three vertices of each face, counter-clockwise from outside."""

COLOUR = {
    TargetState.trusted: (43, 140, 214),
    TargetState.provisional: (118, 128, 140),
    TargetState.quarantined: (224, 90, 10),
}
"""Of targets, by their state."""
LEFT, RIGHT = (43, 140, 214), (128, 148, 168)
"""Of the two cameras."""
PLACE = (164, 48, 168)
"""Of the place where a target is wanted, and of what is selected."""

_RAMP = np.array([(43, 140, 214), (226, 164, 46), (224, 90, 10)], dtype=float)
_SIDES = 16


def residual_colours(residual_mm: Float[np.ndarray, "n"], worst_mm: float) -> UInt8[np.ndarray, "n 3"]:
    """From blue, nothing, to orange, ``worst_mm`` or more; grey where it is not known."""
    at = np.clip(np.nan_to_num(residual_mm) / max(worst_mm, 1e-9), 0, 1) * (len(_RAMP) - 1)
    rgb = np.stack([np.interp(at, np.arange(len(_RAMP)), _RAMP[:, channel]) for channel in range(3)], axis=1)
    rgb[np.isnan(residual_mm)] = COLOUR[TargetState.provisional]
    return np.round(rgb).astype(np.uint8)


def css(colour: tuple[int, int, int] | UInt8[np.ndarray, "3"]) -> str:
    """The colour as a style sheet writes it."""
    return "#" + "".join(f"{int(channel):02x}" for channel in colour)


def ramp_css() -> str:
    """The colours of residuals as a style sheet's gradient."""
    return f"linear-gradient(90deg, {', '.join(css(colour.astype(np.uint8)) for colour in _RAMP)})"


def worst_shown_mm(residual_mm: Float[np.ndarray, "n"]) -> float:
    """The residual at the end of the colours: a round number that 95 % stay below; 1 where none is known."""
    known = residual_mm[np.isfinite(residual_mm)]
    return _round_up(float(np.percentile(known, 95))) if len(known) and known.max() > 0 else 1.0


def default_magnification(cov_mm2: Float[np.ndarray, "k 3 3"], extent_mm: float) -> float:
    """1, 2, 5, 10 ... 100 000: that at which a typical ellipsoid is well seen, about a twentieth of the scene."""
    sigma = ellipsoids(cov_mm2)[1].max(axis=1, initial=0.0)
    if not (sigma > 0).any():
        return 1.0
    return float(np.clip(_round_up(0.025 * extent_mm / float(np.median(sigma[sigma > 0]))), 1.0, 1e5))


def ellipsoids(cov_mm2: Float[np.ndarray, "k 3 3"]) -> tuple[Float[np.ndarray, "k 4"], Float[np.ndarray, "k 3"]]:
    """Orientations (w, x, y, z) and semi-axes of one sigma (mm) of covariances."""
    variance, axes = np.linalg.eigh(cov_mm2)
    axes = axes * np.where(np.linalg.det(axes) < 0, -1.0, 1.0)[:, None, None]
    return quaternions_wxyz(axes), np.sqrt(np.maximum(variance, 0.0))


def facing_wxyz(view: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 4"]:
    """Orientations (w, x, y, z) that turn z towards unit directions; towards −z where none is known."""
    z = np.where(np.isfinite(view), view, [0.0, 0.0, -1.0])
    helper = np.where(np.abs(z[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return quaternions_wxyz(np.stack([x, np.cross(z, x), z], axis=2))


def quaternions_wxyz(R: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 4"]:
    """Rotations as (w, x, y, z); see ``Pose.quaternion_xyzw``."""
    a, b, c = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    wx, wy, wz = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    rows = [
        [1 + a + b + c, wx, wy, wz],
        [wx, 1 + a - b - c, xy, xz],
        [wy, xy, 1 - a + b - c, yz],
        [wz, xz, yz, 1 - a - b + c],
    ]
    Q = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    largest = np.argmax(np.einsum("kii->ki", Q), axis=1)
    q = Q[np.arange(len(R)), largest]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def disc() -> Mesh:
    """A trusted target: a thin disc of radius 1 that faces z."""
    return _turned([(0.0, 0.1), (1.0, 0.1), (1.0, -0.1), (0.0, -0.1)])


def ring() -> Mesh:
    """A provisional target: a flat ring of radius 1 that faces z."""
    return _turned([(0.68, 0.1), (1.0, 0.1), (1.0, -0.1), (0.68, -0.1), (0.68, 0.1)])


def cross() -> Mesh:
    """A quarantined target: a flat cross that faces z."""
    bars = []
    for angle in (np.pi / 4, -np.pi / 4):
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = (each.ravel() for each in np.meshgrid([-1.15, 1.15], [-0.24, 0.24], [-0.1, 0.1], indexing="ij"))
        bars.append(np.stack([c * x - s * y, s * x + c * y, z], axis=1))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([face for p, q, r, s in quads for face in ((p, q, r), (p, r, s))])
    return np.concatenate(bars), np.concatenate([faces, faces + 8])


def ball() -> Mesh:
    """A sphere of radius 1."""
    angle = np.linspace(np.pi / 2, -np.pi / 2, 9)
    return _turned([(float(np.cos(a)), float(np.sin(a))) for a in angle])


def _turned(profile: list[tuple[float, float]]) -> Mesh:
    """What a profile (radius, z), from above and outwards downwards, becomes when it is turned about z."""
    around = np.arange(_SIDES) * (2 * np.pi / _SIDES)
    vertices = np.concatenate([np.c_[r * np.cos(around), r * np.sin(around), np.full(_SIDES, z)] for r, z in profile])
    i = np.arange(_SIDES)
    j = (i + 1) % _SIDES
    faces = []
    for k in range(len(profile) - 1):
        upper, lower = k * _SIDES, (k + 1) * _SIDES
        faces += [np.c_[upper + i, lower + i, lower + j], np.c_[upper + i, lower + j, upper + j]]
    return vertices, np.concatenate(faces)


class Path:
    """Where the sensor was: a polyline with gaps, thinned out evenly when it grows too long to be shown."""

    def __init__(self, most: int = 1500) -> None:
        self._most = most
        self._every, self._skipped, self._is_joined = 1, 0, False
        self._xyz_mm: list[np.ndarray] = []
        self._residual_mm: list[float] = []
        self._joined: list[bool] = []

    def __len__(self) -> int:
        return len(self._xyz_mm)

    def add(self, xyz_mm: Float[np.ndarray, "3"], residual_mm: float) -> None:
        """The next frame has a pose."""
        self._skipped += 1
        if self._is_joined and self._skipped < self._every:
            return
        self._xyz_mm.append(xyz_mm)
        self._residual_mm.append(residual_mm)
        self._joined.append(self._is_joined)
        self._is_joined, self._skipped = True, 0
        if len(self) > self._most:
            self._thin_out()

    def break_off(self) -> None:
        """The next frame has none."""
        self._is_joined = False

    def segments(
        self,
    ) -> tuple[Float[np.ndarray, "s 2 3"], Float[np.ndarray, "s"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
        """Its lines and their residuals, and its points and theirs (mm)."""
        xyz, residual = np.array(self._xyz_mm).reshape(-1, 3), np.array(self._residual_mm)
        end = np.flatnonzero(np.array(self._joined, dtype=bool))
        lines = np.stack([xyz[end - 1], xyz[end]], axis=1).reshape(-1, 2, 3)
        return lines, np.maximum(residual[end - 1], residual[end]), xyz, residual

    def _thin_out(self) -> None:
        """Drop every second point, but never one beside a gap."""
        joined = np.array(self._joined)
        is_end = ~np.r_[joined[1:], False]
        keep = np.flatnonzero(~joined | is_end | (np.arange(len(joined)) % 2 == 0))
        if len(keep) > 0.9 * len(joined):  # gaps everywhere: the oldest goes
            keep = np.arange(len(joined) // 4, len(joined))
            joined[keep[0]] = False
        else:
            self._every *= 2
        self._xyz_mm = [self._xyz_mm[k] for k in keep]
        self._residual_mm = [self._residual_mm[k] for k in keep]
        self._joined = [bool(joined[k]) for k in keep]


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10 ... times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1 - 1e-9)))
