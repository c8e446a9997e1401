"""The compiled inner loops of the renderer: triangles into a depth buffer, shading, exact discs. Knows no scene."""

import numpy as np
from jaxtyping import Float, Float32, Int, Int32
from numba import njit

_NEAREST_MM = 20.0  # triangles nearer than this are not drawn


@njit(cache=True, nogil=True)
def draw_faces(
    uv_px: Float[np.ndarray, "v 2"],
    z_mm: Float[np.ndarray, "v"],
    face: Int[np.ndarray, "f 3"],
    inverse_depth: Float32[np.ndarray, "h w"],
    owner: Int32[np.ndarray, "h w"],
) -> None:
    """Fills 1/z (1/mm) and the number of the nearest triangle that faces the camera, at every pixel centre.

    Edges are taken as straight in the distorted image: triangles must be small.
    """
    h, w = inverse_depth.shape
    for f in range(face.shape[0]):
        i, j, k = face[f, 0], face[f, 1], face[f, 2]
        if not (z_mm[i] > _NEAREST_MM and z_mm[j] > _NEAREST_MM and z_mm[k] > _NEAREST_MM):
            continue
        ax, ay, bx, by, cx, cy = uv_px[i, 0], uv_px[i, 1], uv_px[j, 0], uv_px[j, 1], uv_px[k, 0], uv_px[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not area < 0:  # v points down: counter-clockwise from outside is a negative area
            continue
        u0, u1 = max(0, int(np.ceil(min(ax, bx, cx)))), min(w - 1, int(np.floor(max(ax, bx, cx))))
        v0, v1 = max(0, int(np.ceil(min(ay, by, cy)))), min(h - 1, int(np.floor(max(ay, by, cy))))
        ia, ib, ic = 1 / z_mm[i], 1 / z_mm[j], 1 / z_mm[k]
        for v in range(v0, v1 + 1):
            for u in range(u0, u1 + 1):
                wb = ((u - ax) * (cy - ay) - (v - ay) * (cx - ax)) / area
                wc = ((bx - ax) * (v - ay) - (by - ay) * (u - ax)) / area
                if wb >= -1e-9 and wc >= -1e-9 and wb + wc <= 1 + 1e-9:
                    inverse = ia + wb * (ib - ia) + wc * (ic - ia)
                    if inverse > inverse_depth[v, u]:
                        inverse_depth[v, u] = inverse
                        owner[v, u] = f


@njit(cache=True, nogil=True)
def _lattice(x: int, y: int, z: int) -> float:
    """A number in 0..1 for each corner of a lattice, at random but always the same."""
    n = (x * 374761393 + y * 668265263 + z * 2147483647) & 0xFFFFFFFF
    n = ((n ^ (n >> 13)) * 1274126177) & 0xFFFFFFFF
    n = ((n ^ (n >> 16)) * 2246822519) & 0xFFFFFFFF
    return float((n >> 8) / 16777216.0)


@njit(cache=True, nogil=True)
def _texture(x: float, y: float, z: float) -> float:
    """Smooth noise in 0..1 of unit grain (value noise: random corners, blended)."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    s, t, r = x - fx, y - fy, z - fz
    s, t, r = s * s * (3 - 2 * s), t * t * (3 - 2 * t), r * r * (3 - 2 * r)
    near = (_lattice(i, j, k) * (1 - s) + _lattice(i + 1, j, k) * s) * (1 - t) + (
        _lattice(i, j + 1, k) * (1 - s) + _lattice(i + 1, j + 1, k) * s
    ) * t
    far = (_lattice(i, j, k + 1) * (1 - s) + _lattice(i + 1, j, k + 1) * s) * (1 - t) + (
        _lattice(i, j + 1, k + 1) * (1 - s) + _lattice(i + 1, j + 1, k + 1) * s
    ) * t
    return float(near * (1 - r) + far * r)


@njit(cache=True, nogil=True)
def shade(
    uv_px: Float[np.ndarray, "v 2"],
    z_mm: Float[np.ndarray, "v"],
    face: Int[np.ndarray, "f 3"],
    owner: Int32[np.ndarray, "h w"],
    vertex_mm: Float[np.ndarray, "v 3"],
    vertex_normal: Float[np.ndarray, "v 3"],
    lamp_mm: Float[np.ndarray, "3"],
    working_mm: float,
    R_camera_map: Float[np.ndarray, "3 3"],
    focal_px: float,
    grey: Float32[np.ndarray, "h w"],
) -> None:
    """Fills grey values: a matt, textured surface lit by a lamp beside the camera and faintly from above; where there
    is none, a dark room with patches, which stand still in map coordinates."""
    h, w = owner.shape
    for v in range(h):
        for u in range(w):
            f = owner[v, u]
            if f < 0:
                x, y = (u - 0.5 * w) / focal_px, (v - 0.5 * h) / focal_px
                scale = 1 / np.sqrt(x * x + y * y + 1)
                dx = (R_camera_map[0, 0] * x + R_camera_map[1, 0] * y + R_camera_map[2, 0]) * scale
                dy = (R_camera_map[0, 1] * x + R_camera_map[1, 1] * y + R_camera_map[2, 1]) * scale
                dz = (R_camera_map[0, 2] * x + R_camera_map[1, 2] * y + R_camera_map[2, 2]) * scale
                room = _texture(4 * dx, 4 * dy, 4 * dz)
                thing = _texture(11 * dx + 50, 11 * dy, 11 * dz)
                grey[v, u] = 10 + 14 * room + (22 * (thing - 0.4) if thing > 0.66 else 0.0)
                continue
            i, j, k = face[f, 0], face[f, 1], face[f, 2]
            ax, ay, bx, by, cx, cy = uv_px[i, 0], uv_px[i, 1], uv_px[j, 0], uv_px[j, 1], uv_px[k, 0], uv_px[k, 1]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            wb = ((u - ax) * (cy - ay) - (v - ay) * (cx - ax)) / area
            wc = ((bx - ax) * (v - ay) - (by - ay) * (u - ax)) / area
            wa, wb, wc = (1 - wb - wc) / z_mm[i], wb / z_mm[j], wc / z_mm[k]  # perspective
            total = wa + wb + wc
            wa, wb, wc = wa / total, wb / total, wc / total
            px = wa * vertex_mm[i, 0] + wb * vertex_mm[j, 0] + wc * vertex_mm[k, 0]
            py = wa * vertex_mm[i, 1] + wb * vertex_mm[j, 1] + wc * vertex_mm[k, 1]
            pz = wa * vertex_mm[i, 2] + wb * vertex_mm[j, 2] + wc * vertex_mm[k, 2]
            nx = wa * vertex_normal[i, 0] + wb * vertex_normal[j, 0] + wc * vertex_normal[k, 0]
            ny = wa * vertex_normal[i, 1] + wb * vertex_normal[j, 1] + wc * vertex_normal[k, 1]
            nz = wa * vertex_normal[i, 2] + wb * vertex_normal[j, 2] + wc * vertex_normal[k, 2]
            lx, ly, lz = lamp_mm[0] - px, lamp_mm[1] - py, lamp_mm[2] - pz
            distance = np.sqrt(lx * lx + ly * ly + lz * lz)
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            cosine = max(0.0, (nx * lx + ny * ly + nz * lz) / (distance * length))
            falloff = min(1.4, (working_mm / distance) ** 2)
            albedo = 0.72 + 0.36 * _texture(px / 22, py / 22, pz / 22) + 0.14 * _texture(px / 3, py / 3, pz / 3)
            grey[v, u] = albedo * (132 * cosine * falloff + 17 + 9 * nz / length)


@njit(cache=True, nogil=True)
def _slope(slopes: Float[np.ndarray, "gh gw 2"], gu: float, gv: float) -> tuple[float, float]:
    """The undistorted slopes at a place between the nodes of a grid."""
    i, j = int(gu), int(gv)
    s, t = gu - i, gv - j
    w00, w01, w10, w11 = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    x = slopes[j, i, 0] * w00 + slopes[j, i + 1, 0] * w01 + slopes[j + 1, i, 0] * w10 + slopes[j + 1, i + 1, 0] * w11
    y = slopes[j, i, 1] * w00 + slopes[j, i + 1, 1] * w01 + slopes[j + 1, i, 1] * w10 + slopes[j + 1, i + 1, 1] * w11
    return x, y


@njit(cache=True, nogil=True)
def _covered(q: Float[np.ndarray, "4 4"], distance: Float[np.ndarray, "4"], radius: float, lines: int) -> float:
    """Share of a pixel in which |q| < radius · m; of its corners: (q, m) and |q|/m.

    The pixel is cut into parallel lines that cross the edge rather than run along it. Along a line, q and m are linear:
    the part inside comes from the roots of a quadratic.
    """
    low, high = distance.min(), distance.max()
    if high < radius:
        return 1.0
    if 2 * low - high > radius:
        return 0.0
    across_u, across_v = distance[1] + distance[3], distance[2] + distance[3]
    total = distance[0] + distance[1] + distance[2] + distance[3]
    one, other = (2, 1) if abs(2 * across_u - total) > abs(2 * across_v - total) else (1, 2)
    inside = 0.0
    for i in range(lines):
        t = (i + 0.5) / lines
        a, b, c = 0.0, 0.0, 0.0  # a s² + 2 b s + c < 0
        for j in range(4):
            begin = q[0, j] + t * (q[one, j] - q[0, j])
            step = q[other, j] + t * (q[3, j] - q[other, j]) - begin
            sign = 1.0 if j < 3 else -radius * radius
            a, b, c = a + sign * step * step, b + sign * begin * step, c + sign * begin * begin
        root2 = b * b - a * c
        if root2 > 0 and a > 0:
            root = np.sqrt(root2)
            inside += max(0.0, min(1.0, (root - b) / a) - max(0.0, (-root - b) / a))
    return inside / lines


@njit(cache=True, nogil=True)
def draw_discs(
    centre_mm: Float[np.ndarray, "d 3"],
    normal: Float[np.ndarray, "d 3"],
    radius_mm: Float[np.ndarray, "d 2"],
    value: Float[np.ndarray, "d 2"],
    box_px: Int[np.ndarray, "d 4"],
    slopes: Float[np.ndarray, "gh gw 2"],
    grid_px: int,
    inverse_depth: Float32[np.ndarray, "h w"],
    tolerance_mm: float,
    lines: int,
    grey: Float32[np.ndarray, "h w"],
) -> None:
    """Draws discs with a rim, in camera coordinates, by the share of each pixel's area that they cover.

    The rays of a pixel's corners are undistorted (bilinear in a grid of slopes, a node each ``grid_px`` from
    −``grid_px`` on) and taken as bilinear between. A ray p meets the disc of centre c, normal n and radius r where
    |q| < r m, with m = n·p and q = (n·c) p − m c. A disc is hidden where the surface is nearer by more than a
    tolerance.
    """
    q, distance = np.empty((4, 4)), np.empty(4)  # of a pixel's corners: q and m; from the disc's centre (mm)
    for d in range(centre_mm.shape[0]):
        c, n = centre_mm[d], normal[d]
        offset = n[0] * c[0] + n[1] * c[1] + n[2] * c[2]
        for v in range(box_px[d, 1], box_px[d, 3] + 1):
            for u in range(box_px[d, 0], box_px[d, 2] + 1):
                z = 0.0
                for k in range(4):  # corners: top left, top right, bottom left, bottom right
                    x, y = _slope(slopes, (u - 0.5 + k % 2) / grid_px + 1, (v - 0.5 + k // 2) / grid_px + 1)
                    m = n[0] * x + n[1] * y + n[2]
                    q[k, 0], q[k, 1], q[k, 2], q[k, 3] = (
                        offset * x - m * c[0],
                        offset * y - m * c[1],
                        offset - m * c[2],
                        m,
                    )
                    distance[k] = np.sqrt(q[k, 0] ** 2 + q[k, 1] ** 2 + q[k, 2] ** 2) / abs(m)
                    z += 0.25 * offset / m
                if inverse_depth[v, u] * (z - tolerance_mm) > 1:
                    continue
                in_inner = _covered(q, distance, radius_mm[d, 0], lines)
                in_outer = _covered(q, distance, radius_mm[d, 1], lines)
                rim = in_outer - in_inner
                grey[v, u] = grey[v, u] * (1 - in_outer) + value[d, 0] * in_inner + value[d, 1] * rim


def warm_up() -> None:
    """Compiles every kernel for the types that it is called with."""
    uv, z, face = np.array([[0.0, 0.0], [0.0, 3.0], [3.0, 0.0]]), np.full(3, 100.0), np.array([[0, 1, 2]])
    inverse_depth, owner = np.zeros((4, 4), dtype=np.float32), np.full((4, 4), -1, dtype=np.int32)
    grey, xyz = np.zeros((4, 4), dtype=np.float32), np.zeros((3, 3))
    draw_faces(uv, z, face, inverse_depth, owner)
    shade(uv, z, face, owner, xyz, xyz + 1.0, np.full(3, 100.0), 100.0, np.eye(3), 100.0, grey)
    one = np.array([[0.0, 0.0, 100.0]])
    box, slopes = np.array([[0, 0, 3, 3]]), np.zeros((4, 4, 2))
    draw_discs(one, -one / 100, np.ones((1, 2)), np.ones((1, 2)), box, slopes, 4, inverse_depth, 4.0, 2, grey)
