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
    samples: int,
    grey: Float32[np.ndarray, "h w"],
) -> None:
    """Draws discs with a rim, in camera coordinates, by the share of each pixel's area that they cover.

    Every sample of a pixel is a ray: undistorted (bilinear in a grid of slopes, a node each ``grid_px`` from
    −``grid_px`` on), cut with the disc's plane, compared with the inner and the outer radius. A disc is hidden where
    the surface is nearer by more than a tolerance.
    """
    for d in range(centre_mm.shape[0]):
        cx, cy, cz = centre_mm[d, 0], centre_mm[d, 1], centre_mm[d, 2]
        nx, ny, nz = normal[d, 0], normal[d, 1], normal[d, 2]
        offset = nx * cx + ny * cy + nz * cz
        inner2, outer2 = radius_mm[d, 0] ** 2, radius_mm[d, 1] ** 2
        for v in range(box_px[d, 1], box_px[d, 3] + 1):
            for u in range(box_px[d, 0], box_px[d, 2] + 1):
                in_inner, in_outer, z = 0, 0, cz
                for a in range(samples):
                    for b in range(samples):
                        gu = (u + (a + 0.5) / samples - 0.5) / grid_px + 1
                        gv = (v + (b + 0.5) / samples - 0.5) / grid_px + 1
                        i, j = int(gu), int(gv)
                        s, t = gu - i, gv - j
                        x = (slopes[j, i, 0] * (1 - s) + slopes[j, i + 1, 0] * s) * (1 - t) + (
                            slopes[j + 1, i, 0] * (1 - s) + slopes[j + 1, i + 1, 0] * s
                        ) * t
                        y = (slopes[j, i, 1] * (1 - s) + slopes[j, i + 1, 1] * s) * (1 - t) + (
                            slopes[j + 1, i, 1] * (1 - s) + slopes[j + 1, i + 1, 1] * s
                        ) * t
                        z = offset / (nx * x + ny * y + nz)
                        r2 = (z * x - cx) ** 2 + (z * y - cy) ** 2 + (z - cz) ** 2
                        in_inner += r2 < inner2
                        in_outer += r2 < outer2
                if in_outer == 0 or inverse_depth[v, u] * (z - tolerance_mm) > 1:
                    continue
                white = in_inner / samples**2
                rim = in_outer / samples**2 - white
                grey[v, u] = grey[v, u] * (1 - white - rim) + value[d, 0] * white + value[d, 1] * rim


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
