"""The outer triangles of Delaunay tetrahedra."""

import numpy as np
from scatters import sphere

from trifix.stages.identify.delaunay import outer_triangles


def test_a_convex_scatter_has_two_triangles_per_point_less_four() -> None:
    xyz = sphere(50, np.random.default_rng(1)).xyz_mm
    triangles = outer_triangles(xyz)
    assert len(triangles) == 2 * 50 - 4
    assert set(triangles.ravel().tolist()) == set(range(50))


def test_facets_shared_by_two_tetrahedra_go_and_so_do_points_inside() -> None:
    corners = 100.0 * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    corners += np.random.default_rng(1).normal(size=(8, 3))
    triangles = outer_triangles(np.concatenate([corners, [[50.0, 50, 50]]]))
    assert 8 not in triangles
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()  # a closed surface


def test_a_flat_scatter_keeps_all_its_triangles() -> None:
    rng = np.random.default_rng(2)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    inside = rng.uniform(-100, 100, size=(40, 2))
    triangles = outer_triangles(inside @ axes[:2] + [10.0, 20, 300])
    assert len(triangles) > 60
    assert set(triangles.ravel().tolist()) == set(range(40))


def test_three_points_are_a_triangle_and_four_a_tetrahedron() -> None:
    xyz = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    assert np.sort(outer_triangles(xyz[:3])).tolist() == [[0, 1, 2]]
    assert len(outer_triangles(xyz)) == 4


def test_points_on_one_line_or_in_one_place_have_none() -> None:
    line = np.arange(6.0)[:, None] * [1.0, 2, 3]
    assert len(outer_triangles(line)) == 0
    assert len(outer_triangles(np.ones((5, 3)))) == 0
