"""The objects of the simulated scenes: triangle meshes, and where targets may stand on them.

Everything is procedural and the same on every run. Knows no camera and no time.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.errors import SimulationError

Heights = Callable[[Float[np.ndarray, "n"], Float[np.ndarray, "n"]], Float[np.ndarray, "n"]]

_SEEN_TOLERANCE_MM = 1.0  # a ray that ends this near the target has reached it


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A triangle mesh in map coordinates, its outside where the faces wind counter-clockwise."""

    vertex_mm: Float[np.ndarray, "v 3"]
    """Corners (mm)."""
    face: Int[np.ndarray, "f 3"]
    """Rows of the corners of each triangle."""
    may_hold: Bool[np.ndarray, "f"]
    """Triangles on which a target may stand: flat enough, and not at an edge."""
    is_convex: bool = False
    """True where the surface cannot hide a target that faces the camera, so that no rays are needed."""

    @property
    def face_normal(self) -> Float[np.ndarray, "f 3"]:
        """Unit normals of the triangles, outwards."""
        return _unit(self._cross())

    @property
    def vertex_normal(self) -> Float[np.ndarray, "v 3"]:
        """Unit normals at the corners: the mean of the triangles around, by area."""
        total = np.zeros_like(self.vertex_mm)
        cross = self._cross()
        for corner in range(3):
            np.add.at(total, self.face[:, corner], cross)
        return _unit(total)

    def _cross(self) -> Float[np.ndarray, "f 3"]:
        a, b, c = (self.vertex_mm[self.face[:, i]] for i in range(3))
        return np.cross(b - a, c - a)

    def scatter(
        self,
        count: int,
        rng: np.random.Generator,
        spacing: float = 0.6,
        where: Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]] | None = None,
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
        """Positions and outward normals of ``count`` targets at random, none nearer to another than ``spacing``
        times the side of the square of surface that it has to itself; ``where`` says which positions are allowed."""
        area = 0.5 * np.linalg.norm(self._cross(), axis=1) * self.may_hold
        normals = self.face_normal
        n = 60 * count
        face = rng.choice(len(area), n, p=area / area.sum())
        p = rng.random((n, 2))
        p[p.sum(axis=1) > 1] = 1 - p[p.sum(axis=1) > 1]  # folded into the triangle
        a, b, c = (self.vertex_mm[self.face[face, i]] for i in range(3))
        xyz = a + p[:, :1] * (b - a) + p[:, 1:] * (c - a)
        allowed = np.ones(n, dtype=bool) if where is None else where(xyz)
        least_mm = spacing * np.sqrt(area.sum() * allowed.mean() / count)
        while True:
            kept: list[int] = []
            for i in np.nonzero(allowed)[0]:
                if not kept or np.min(np.linalg.norm(xyz[kept] - xyz[i], axis=1)) >= least_mm:
                    kept.append(int(i))
                    if len(kept) == count:
                        return xyz[kept], normals[face[kept]]
            least_mm *= 0.9

    def hides(self, centre_mm: Float[np.ndarray, "n 3"], xyz_mm: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Whether the surface lies between each camera centre and its point, which is on the surface itself."""
        if self.is_convex or len(xyz_mm) == 0:
            return np.zeros(len(xyz_mm), dtype=bool)
        try:
            import trimesh
        except ImportError as error:
            raise SimulationError(
                'Scenes with hollows and walls need a ray caster, which is not installed: pip install "trifix[sim]".'
            ) from error
        mesh = trimesh.Trimesh(self.vertex_mm, self.face, process=False)
        ray = xyz_mm - centre_mm
        hit, row, _ = mesh.ray.intersects_location(centre_mm, _unit(ray), multiple_hits=False)
        free = np.full(len(ray), np.inf)
        free[row] = np.linalg.norm(hit - centre_mm[row], axis=1)
        return np.asarray(free < np.linalg.norm(ray, axis=1) - _SEEN_TOLERANCE_MM)


def rectangle(
    corner_mm: tuple[float, float, float],
    along_u_mm: tuple[float, float, float],
    along_v_mm: tuple[float, float, float],
    height: Heights | None = None,
    cell_mm: float = 20.0,
) -> Surface:
    """A rectangle whose outside is on the side of u × v, raised along it by ``height(u, v)`` (mm of mm)."""
    corner, u, v = (np.array(a) for a in (corner_mm, along_u_mm, along_v_mm))
    length_u, length_v = np.linalg.norm(u), np.linalg.norm(v)
    nu, nv = (max(3, round(float(length) / cell_mm)) for length in (length_u, length_v))
    s, t = (g.ravel() for g in np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij"))
    vertex = corner + s[:, None] * u + t[:, None] * v
    if height is not None:
        vertex += height(s * length_u, t * length_v)[:, None] * np.cross(u, v) / (length_u * length_v)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij"))
    a = i * (nv + 1) + j
    b, c, d = a + nv + 1, a + nv + 2, a + 1
    face = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    inner = (i > 0) & (i < nu - 1) & (j > 0) & (j < nv - 1)
    return Surface(vertex, face, np.tile(inner, 2), is_convex=height is None)


def joined(parts: list[Surface]) -> Surface:
    """Several surfaces as one, which may hide parts of itself."""
    first = np.cumsum([0] + [len(part.vertex_mm) for part in parts])
    return Surface(
        np.concatenate([part.vertex_mm for part in parts]),
        np.concatenate([part.face + k for part, k in zip(parts, first, strict=False)]),
        np.concatenate([part.may_hold for part in parts]),
    )


def sphere(radius_mm: float) -> Surface:
    """A sphere about the origin."""
    direction, face = _icosphere(4)
    return Surface(radius_mm * direction, face, np.ones(len(face), dtype=bool), is_convex=True)


def head(height_mm: float) -> Surface:
    """A head of about 20,000 triangles about the origin: z up, the face towards +x, ears, nose and hollows.

    An ellipsoid in polar coordinates, whose radius is raised and lowered by Gaussian bumps in azimuth and elevation.
    """
    direction, face = _icosphere(5)
    azimuth = np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))
    elevation = np.degrees(np.arcsin(direction[:, 2].clip(-1, 1)))
    radius = 1 / np.linalg.norm(direction / [0.42, 0.34, 0.5], axis=1)
    # amplitude, azimuth, elevation, widths in azimuth and elevation (degrees)
    bumps = [
        (0.23, 0, -9, 7, 8),  # nose
        (0.13, 0, 3, 6, 9),  # its bridge
        (0.08, 0, 21, 30, 6),  # brow
        (-0.13, 23, 9, 10, 7),  # eyes
        (-0.13, -23, 9, 10, 7),
        (0.06, 38, -10, 13, 10),  # cheeks
        (0.06, -38, -10, 13, 10),
        (-0.05, 0, -22, 14, 3),  # lips, parted
        (0.05, 0, -26, 11, 3),
        (0.05, 0, -19, 11, 3),
        (-0.06, 0, -33, 14, 4),
        (0.15, 0, -43, 17, 7),  # chin
        (-0.20, 60, -42, 28, 15),  # under the jaw
        (-0.20, -60, -42, 28, 15),
        (0.26, 99, -2, 5, 15),  # ears
        (0.26, -99, -2, 5, 15),
        (-0.10, 87, -2, 5, 10),  # before the ears
        (-0.10, -87, -2, 5, 10),
        (0.10, 180, 12, 45, 30),  # back of the head
        (-0.20, 180, -45, 60, 16),  # nape
    ]
    for amplitude, at_azimuth, at_elevation, wide, high in bumps:
        turn = (azimuth - at_azimuth + 180) % 360 - 180
        # near the poles a degree of azimuth is no distance: the bump is faded there
        bump = np.exp(-0.5 * (turn / wide) ** 2 - 0.5 * ((elevation - at_elevation) / high) ** 2)
        radius *= 1 + amplitude * bump * np.cos(np.radians(elevation))
    vertex = height_mm * radius[:, None] * direction
    bare = Surface(vertex, face, np.ones(len(face), dtype=bool))
    bend = np.einsum("fi,fci->fc", bare.face_normal, bare.vertex_normal[face]).min(axis=1)
    above_neck = vertex[face, 2].mean(axis=1) > -0.42 * height_mm
    return Surface(vertex, face, (bend > np.cos(np.radians(14))) & above_neck)


def _unit(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _icosphere(subdivisions: int) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Unit vertices and faces of an icosahedron whose triangles are halved along every edge again and again."""
    g = (1 + np.sqrt(5)) / 2
    vertex = np.array(
        [
            *([-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g]),
            *([0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]),
        ]
    )
    face = np.array(
        [
            *([0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2]),
            *([10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5]),
            *([2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]),
        ]
    )
    for _ in range(subdivisions):
        edge = np.sort(np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]]), axis=1)
        unique, row = np.unique(edge, axis=0, return_inverse=True)
        ab, bc, ca = row.reshape(3, -1) + len(vertex)
        vertex = np.concatenate([vertex, vertex[unique].sum(axis=1)])
        vertex = _unit(vertex)
        a, b, c = face.T
        face = np.concatenate([np.stack(t, axis=1) for t in [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]])
    return _unit(vertex), face
