"""Maps survive being written; a map that cannot be right is refused with its line."""

from pathlib import Path

import numpy as np
import pytest

from trifix.errors import MapError
from trifix.files.maps import read_map, write_map, write_ply
from trifix.records import ReferenceMap, TargetState


def made_map(k: int = 40) -> ReferenceMap:
    """Targets in every state, some without a direction."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(k, 3, 3)) * 0.05
    view = rng.normal(size=(k, 3))
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    view[::7] = np.nan
    return ReferenceMap.given(
        xyz_mm=rng.uniform(-500, 500, (k, 3)),
        cov_mm2=A @ np.swapaxes(A, 1, 2),
        view=view,
        id=rng.permutation(1000)[:k],
        sightings=rng.integers(0, 99, k),
        state=np.arange(k) % 4,
    )


def test_a_map_survives_being_written_but_for_its_removed_targets(tmp_path: Path) -> None:
    written = made_map()
    write_map(written, tmp_path / "map.csv")
    read = read_map(tmp_path / "map.csv")
    kept = written.state != TargetState.removed
    assert len(read) == 30
    assert read.id.tolist() == written.id[kept].tolist()
    assert read.state.tolist() == written.state[kept].tolist()
    assert read.sightings.tolist() == written.sightings[kept].tolist()
    np.testing.assert_allclose(read.xyz_mm, written.xyz_mm[kept], atol=5.1e-7)
    np.testing.assert_allclose(read.cov_mm2, written.cov_mm2[kept], rtol=1e-8)
    np.testing.assert_allclose(read.view, written.view[kept], atol=1e-6)
    assert read.last_seen.tolist() == [-1] * 30


def test_the_columns_are_those_of_the_format(tmp_path: Path) -> None:
    write_map(ReferenceMap.given(np.array([[1.0, -2.0, 0.5]])), tmp_path / "map.csv")
    assert (tmp_path / "map.csv").read_text() == (
        "id,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz,sightings,nx,ny,nz,state\n"
        "0,1.000000,-2.000000,0.500000,0,0,0,0,0,0,0,,,,trusted\n"
    )


def test_writing_again_what_was_read_gives_the_same_bytes(tmp_path: Path) -> None:
    write_map(made_map(), tmp_path / "a.csv")
    write_map(read_map(tmp_path / "a.csv"), tmp_path / "b.csv")
    write_map(read_map(tmp_path / "b.csv"), tmp_path / "c.csv")
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "c.csv").read_bytes()


def test_a_map_without_targets_survives_too(tmp_path: Path) -> None:
    write_map(ReferenceMap.empty(), tmp_path / "map.csv")
    assert len(read_map(tmp_path / "map.csv")) == 0


def test_only_id_and_position_are_required(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("z_mm,id,x_mm,y_mm\n3,7,1,2\n")
    read = read_map(str(tmp_path / "map.csv"))
    assert (read.id.tolist(), read.xyz_mm.tolist()) == ([7], [[1, 2, 3]])
    assert (read.state.tolist(), read.sightings.tolist()) == ([TargetState.trusted], [0])
    assert np.isnan(read.view).all()
    np.testing.assert_array_equal(read.cov_mm2, 0)


def test_optional_cells_may_be_empty_and_directions_are_normalised(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text(
        "id,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz,sightings,nx,ny,nz,state\n"
        "0,1,2,3,,,,,,,,,,,\n"
        "1,1,2,4,1,0,0,1,0,1,5,0,3,4,provisional\n"
    )
    read = read_map(tmp_path / "map.csv")
    assert read.sightings.tolist() == [0, 5]
    assert read.state.tolist() == [TargetState.trusted, TargetState.provisional]
    assert np.isnan(read.view[0]).all()
    np.testing.assert_allclose(read.view[1], [0, 0.6, 0.8])
    np.testing.assert_array_equal(read.cov_mm2, [np.zeros((3, 3)), np.eye(3)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,x_mm,y_mm\n", r"map\.csv: column 'z_mm' is missing"),
        ("id,x_mm,y_mm,z_mm\n1,2,3,nan\n", r"line 2, column 'z_mm': found 'nan', expected a finite number"),
        ("id,x_mm,y_mm,z_mm\n-1,2,3,4\n", r"line 2, column 'id': found -1, expected 0 to 9007199254740992"),
        ("id,x_mm,y_mm,z_mm\n9007199254740993,2,3,4\n", r"line 2, column 'id': found 9007199254740993, expected 0 to"),
        ("id,x_mm,y_mm,z_mm\n4,2,3,4\n5,2,3,4\n4,2,3,4\n", r"line 4: id 4 already stands in line 2, expected it once"),
        ("id,x_mm,y_mm,z_mm,state\n1,2,3,4,truste\n", r"line 2, column 'state': found 'truste'.*nearest is trusted"),
        ("id,x_mm,y_mm,z_mm,state\n1,2,3,4,removed\n", r"column 'state': found 'removed'"),
        ("id,x_mm,y_mm,z_mm,nx,ny,nz\n1,2,3,4,0,1,\n", r"line 2: nz is empty, expected all of nx, ny, nz or none"),
        ("id,x_mm,y_mm,z_mm,nx\n1,2,3,4,1\n", r"line 2: ny and nz is empty, expected all of"),
        ("id,x_mm,y_mm,z_mm,nx,ny,nz\n1,2,3,4,0,0,0\n", r"line 2: nx, ny, nz is zero, no direction"),
        ("id,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz\n1,2,3,4,1,2,0,1,0,1\n", r"line 2: xx \.\.\. zz is no covariance"),
        ("id,x_mm,y_mm,z_mm,xx,xy,xz,yy,yz,zz\n1,2,3,4,1,0,0,1,0,inf\n", r"column 'zz': found 'inf'"),
    ],
)
def test_an_impossible_map_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "map.csv").write_text(text)
    with pytest.raises(MapError, match=message):
        read_map(tmp_path / "map.csv")


def test_a_map_in_metres_is_refused_with_a_hint_at_the_unit(tmp_path: Path) -> None:
    rows = [f"{i},{0.1 * i},{0.03 * i * i},0.4" for i in range(8)]
    (tmp_path / "map.csv").write_text("\n".join(["id,x_mm,y_mm,z_mm", *rows]) + "\n")
    with pytest.raises(MapError, match=r"map\.csv: all 8 targets lie within 1\.63 mm, .*in metres\? Multiply"):
        read_map(tmp_path / "map.csv")


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"map\.csv does not exist"):
        read_map(tmp_path / "map.csv")


def test_the_point_cloud_holds_the_trusted_targets_in_millimetres(tmp_path: Path) -> None:
    written = made_map()
    write_ply(written, tmp_path / "map.ply")
    lines = (tmp_path / "map.ply").read_text().splitlines()
    assert lines[:2] == ["ply", "format ascii 1.0"]
    assert "element vertex 10" in lines
    xyz = np.array([line.split() for line in lines[lines.index("end_header") + 1 :]], dtype=float)
    np.testing.assert_allclose(xyz, written.xyz_mm[written.state == TargetState.trusted], atol=5.1e-7)
