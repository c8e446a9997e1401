"""One small frame through every stage, against what each stage made of it when somebody last looked.

`frame.csv` holds the dots of twelve targets and of three false ones in both images, `map.csv` the targets (mm). A
difference is a change of behaviour: if it is meant, `pytest tests/golden --renew-golden` writes the outputs anew. The
detector's golden output is compared beside its own tests.
"""

from pathlib import Path

import numpy as np
import pytest

from constellations import RIG, fixed, front_map, indexed
from trifix.records import Dots, Identification, ReferenceMap, SensorPoints, StereoDots, StereoMatches
from trifix.stages.identify import identifier
from trifix.stages.identify.congruence import IdentifyOptions
from trifix.stages.match import match
from trifix.stages.orient import orient
from trifix.stages.triangulate import triangulate
from trifix.stages.verify import Evidence, verify

HERE = Path(__file__).parent
SIGMA_PX = 0.1


@pytest.fixture(scope="module")
def dots() -> StereoDots:
    camera, u, v = np.loadtxt(HERE / "frame.csv", delimiter=",").T
    uv = np.stack([u, v], axis=1)
    return StereoDots(Dots.of(uv[camera == 0], SIGMA_PX), Dots.of(uv[camera == 1], SIGMA_PX))


@pytest.fixture(scope="module")
def map() -> ReferenceMap:
    return front_map(np.loadtxt(HERE / "map.csv", delimiter=","), 0.05)


@pytest.fixture(scope="module")
def matches(dots: StereoDots) -> StereoMatches:
    return match(dots, RIG)


@pytest.fixture(scope="module")
def points(dots: StereoDots, matches: StereoMatches) -> SensorPoints:
    return triangulate(dots, matches, RIG)


@pytest.fixture(scope="module")
def hypotheses(points: SensorPoints, map: ReferenceMap) -> Identification:
    technique = identifier(IdentifyOptions(technique="frequency"))
    technique.learn(map, np.zeros(0, dtype=np.int64))
    portions = list(technique.identify(points, map))
    return Identification(np.vstack([p.point for p in portions]), np.vstack([p.target for p in portions]))


def compare(
    request: pytest.FixtureRequest, name: str, columns: str, found: np.ndarray, rtol: float, atol: float
) -> None:
    """The table against its golden one, or in its place."""
    file = HERE / f"{name}.csv"
    if request.config.getoption("--renew-golden", default=False):
        np.savetxt(file, found, fmt="%.12g", delimiter=",", header=columns)
    golden = np.loadtxt(file, delimiter=",", ndmin=2)
    assert found.shape == golden.shape
    np.testing.assert_allclose(found, golden, rtol=rtol, atol=atol)


def test_match(request, matches):
    found = np.stack([matches.left, matches.right, matches.epipolar_px, matches.epipolar_sigma_px], axis=1)
    found = found[np.lexsort((matches.right, matches.left))]
    compare(request, "match", "left,right,epipolar_px,epipolar_sigma_px", found, 0, 1e-8)


def test_triangulate(request, points):
    upper = points.cov_mm2[:, *np.triu_indices(3)]
    compare(request, "triangulate", "x,y,z,xx,xy,xz,yy,yz,zz", np.hstack([points.xyz_mm, upper]), 1e-7, 1e-7)


def test_identify(request, hypotheses):
    """All hypotheses, as a set: vertices in the order of the points, rows in that of their numbers."""
    order = np.argsort(hypotheses.point, axis=1)
    point, target = (np.take_along_axis(x, order, axis=1) for x in (hypotheses.point, hypotheses.target))
    found = np.unique(np.hstack([point, target]), axis=0)
    assert len(found) == len(hypotheses)
    compare(request, "identify", "point,point,point,target,target,target", found, 0, 0)


def test_verify(request, points, map, hypotheses, matches):
    fix = fixed(verify(Evidence.of(points, matches), map, indexed(map), hypotheses, orient(points, map, hypotheses)))
    order = np.argsort(fix.target)
    found = np.stack([fix.target[order], fix.point[order], fix.residual_mm[order]], axis=1)
    compare(request, "verify", "target,point,residual_mm", found, 0, 1e-6)


def test_pose(request, points, map, hypotheses, matches):
    fix = fixed(verify(Evidence.of(points, matches), map, indexed(map), hypotheses, orient(points, map, hypotheses)))
    sigma = np.sqrt(np.diag(fix.cov))
    found = np.concatenate([fix.T_world_sensor.t_mm, fix.T_world_sensor.quaternion_xyzw, sigma])
    compare(request, "pose", "x,y,z,qx,qy,qz,qw,six sigmas (mm and rad)", found[None], 1e-6, 1e-9)
    assert fix.p_chance < 1e-9
