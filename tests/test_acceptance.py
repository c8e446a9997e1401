"""The virtual acceptance test: what it measures, and what it says of it."""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from trifix.errors import TrifixError
from trifix.experiments.acceptance import Acceptance, Limit, TestLength, run_acceptance
from trifix.experiments.acceptance_page import acceptance_rows, write_acceptance
from trifix.records import ReferenceMap
from trifix.sources.scenes import LINES_MM


def test_the_lines_of_the_artefact_have_seven_directions_and_more() -> None:
    away = np.array([np.subtract(b, a) for a, b in LINES_MM])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    apart_deg = np.degrees(np.arccos(np.clip(np.abs(away @ away.T), 0, 1)))
    assert len(LINES_MM) >= 7
    assert apart_deg[~np.eye(len(away), dtype=bool)].min() > 10


def test_a_limit_grows_with_the_length() -> None:
    assert Limit(0.01, 0.02).at(500.0) == pytest.approx(0.02)


def made(*errors_mm: float, missing: int = 0) -> Acceptance:
    lengths = tuple(TestLength(1, 1, 1000.0, error, 0.01) for error in errors_mm)
    return Acceptance(lengths, Limit(0.015, 0.015), 10, 2, missing)


def test_the_limit_is_met_only_by_all_lengths() -> None:
    assert made(0.029, -0.029).is_met
    assert not made(0.029, -0.031).is_met
    assert made(0.029, -0.031).exceeding == 1
    assert not made(0.0, missing=1).is_met
    assert made(0.01, -0.01).normalised_rms == pytest.approx(1.0)


def test_a_page_says_that_it_is_simulated_and_loads_nothing(tmp_path: Path) -> None:
    page = write_acceptance(made(0.02, 0.04), tmp_path / "out", "trifix acceptance").read_text(encoding="utf-8")
    assert "simulated" in page
    assert "http" not in page.replace("http://www.w3.org", "").replace("http://purl.org", "")
    with (tmp_path / "out" / "lengths.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["error_mm"]) for row in rows] == [0.02, 0.04]
    assert (tmp_path / "out" / "lengths.png").stat().st_size > 5000
    assert dict(acceptance_rows(made(0.02, 0.04)))["limit"].startswith("not met: 1 lengths beyond")


def test_lengths_are_measured_as_well_as_their_covariances_say() -> None:
    found = run_acceptance(np.array([3]), 150)
    assert len(found.lengths) == 5 * len(LINES_MM)
    assert found.missing == 0
    assert found.largest_mm < 0.1
    assert 0.6 < found.normalised_rms < 1.5


def test_too_few_frames_are_refused_in_a_sentence() -> None:
    with pytest.raises(TrifixError, match=r"Scale bar \d of recording 3 was not found"):
        run_acceptance(np.array([3]), 4)


def test_the_command_refuses_impossible_numbers(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "trifix", "acceptance", "-o", str(tmp_path / "out"), "--frames", "0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--frames" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_distance_has_the_sigma_that_the_joint_covariance_gives() -> None:
    xyz = np.array([[0.0, 0, 0], [100, 0, 0]])
    own, shared = np.diag([0.04, 0.01, 0.01]), np.diag([0.03, 0.0, 0.0])
    apart = ReferenceMap.given(xyz, np.stack([own, own]))
    assert apart.distance(0, 1) == pytest.approx((100.0, np.sqrt(0.08)))
    joint = np.block([[own, shared], [shared, own]])
    together = ReferenceMap(
        apart.id,
        apart.xyz_mm,
        apart.cov_mm2,
        apart.view,
        apart.sightings,
        apart.last_seen,
        apart.misses,
        apart.state,
        joint,
    )
    assert together.distance(0, 1) == pytest.approx((100.0, np.sqrt(0.02)))
    assert together.rows(np.array([1, 0])).distance(0, 1) == pytest.approx((100.0, np.sqrt(0.02)))
