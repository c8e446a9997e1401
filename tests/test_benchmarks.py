import json
import sys
from pathlib import Path

import numpy as np
import pytest

from trifix.config import Config
from trifix.geometry.pose import Pose

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import adversarial
import bench
import chance
import cold_start
import made_frames
import shards


def made(kind: str, f: int = 60, seed: int = 5) -> tuple[made_frames.World, made_frames.Batch]:
    return adversarial.KINDS[kind](np.random.default_rng(seed), f)


@pytest.mark.parametrize("kind", adversarial.KINDS)
def test_frames_hold_four_to_thirty_points_before_the_sensor(kind: str) -> None:
    world, batch = made(kind)
    assert 30 <= len(world.map) <= 1000
    assert set(batch.part.tolist()) <= set(range(len(adversarial.PARTS[kind])))
    for k, frame in enumerate(batch.frames()):
        points = frame.content
        assert 4 <= len(points) <= 30
        assert points.xyz_mm[:, 2].min() > 200.0
        assert points.xyz_mm[:, 2].max() < 800.0
        along = np.sqrt(np.linalg.eigvalsh(points.cov_mm2))
        assert 0.0199 < along[:, 0].min() <= along[:, 0].max() < 0.1001
        assert np.all(along[:, 2] > 1.99 * along[:, 0])
        label = batch.label[k, : len(points)]
        known = label[label >= 0]
        assert len(np.unique(known)) == len(known) <= len(points)
        assert known.max(initial=-1) < len(world.map)


@pytest.mark.parametrize("kind", ["decoy", "grid", "moved"])
def test_points_are_their_targets_but_for_the_noise_that_they_state(kind: str) -> None:
    variance = []
    for seed in range(4):
        world, batch = made(kind, seed=seed)
        fits = [batch.pose_of_labels(k, world.map) for k in range(len(batch))]
        variance += [fit[2] for fit in fits if fit is not None]
    assert len(variance) > 50
    assert 0.93 < np.mean(variance) < 1.07


@pytest.mark.parametrize("kind", ["foreign", "mirrored", "ghosts"])
def test_no_pose_is_right_where_nothing_of_the_map_is_seen(kind: str) -> None:
    world, batch = made(kind)
    assert (batch.label == -1).all()
    assert not batch.is_right(0, Pose.identity(), world.map)


def test_a_pose_is_right_within_the_limits_only() -> None:
    world, batch = made("moved")
    k = next(k for k in range(len(batch)) if batch.pose_of_labels(k, world.map) is not None)
    truth, cov, _ = batch.pose_of_labels(k, world.map)
    sigma = np.sqrt(np.linalg.eigvalsh(cov)[-1])
    assert batch.is_right(k, truth, world.map)
    assert batch.is_right(k, truth @ Pose.exp(np.array([2.0, 0, 0, 0, 0, 0])), world.map)
    far = np.array([10.0 + 100 * sigma, 0, 0, 0, 0, 0])
    assert not batch.is_right(k, truth @ Pose.exp(far), world.map)


def test_decoys_are_congruent_to_targets_of_another_place() -> None:
    world, batch = made("decoy")
    for k in np.flatnonzero(batch.part == 1)[:10]:
        false = batch.xyz_mm[k, : batch.count[k]][batch.label[k, : batch.count[k]] < 0]
        assert 4 <= len(false) <= 0.4 * batch.count[k]
        side = np.linalg.norm(false[0] - false[1:4], axis=1)
        distance = np.linalg.norm(world.map.xyz_mm[:, None] - world.map.xyz_mm[None], axis=2)
        alike = np.array([[np.abs(row - s).min() for s in side] for row in distance])
        assert alike.max(axis=1).min() < 1.0  # some target has neighbours at all these distances


def test_a_scattered_map_has_its_size_and_no_two_targets_in_one_place() -> None:
    world = made_frames.made_world(np.random.default_rng(1), 700, 25.0, sigma_mm=0.0)
    xyz = world.map.xyz_mm
    assert len(xyz) == 700
    distance, _ = world.tree.query(xyz, k=2)
    assert distance[:, 1].min() > 7.4
    assert 10.0 < np.median(distance[:, 1]) < 20.0
    np.testing.assert_allclose(np.linalg.norm(world.map.view, axis=1), 1.0, rtol=1e-12)


def counted(task: shards.Task) -> dict[str, object]:
    return {"sum": int(task.rng().integers(1000)), "frames": task.frames}


def told(done: dict[str, dict]) -> str:
    return f"{len(done)}"


def test_a_run_that_was_killed_goes_on_and_gives_the_same(tmp_path: Path) -> None:
    todo = shards.tasks(["a", "b"], 25, 10, 3, Config())
    assert [task.frames for task in todo] == [10, 10, 10, 10, 5, 5]
    whole = shards.run(tmp_path / "whole.jsonl", todo, counted, told)
    lines = (tmp_path / "whole.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "cut.jsonl").write_text("".join(lines[:4]) + lines[4][:9])
    calls = []

    def watched(task: shards.Task) -> dict[str, object]:
        calls.append(task.key)
        return counted(task)

    assert shards.run(tmp_path / "cut.jsonl", todo, watched, told) == whole
    assert calls == ["b/1", "a/2", "b/2"]
    assert (tmp_path / "cut.jsonl").read_text() == (tmp_path / "whole.jsonl").read_text()
    assert len({result["sum"] for result in whole.values()}) > 3


def test_a_run_with_another_seed_does_not_go_on(tmp_path: Path) -> None:
    shards.run(tmp_path / "run.jsonl", shards.tasks(["a"], 10, 10, 1, Config()), counted, told)
    with pytest.raises(SystemExit, match="of a run with another seed; name another folder"):
        shards.run(tmp_path / "run.jsonl", shards.tasks(["a"], 10, 10, 2, Config()), counted, told)


def test_misleading_frames_are_counted_by_kind(tmp_path: Path) -> None:
    summary = adversarial.measure(tmp_path, 6, tuple(adversarial.KINDS), 1, 3, 1, Config())
    assert summary["frames"] == 42
    for kind in summary["kinds"].values():
        assert kind["right"] + kind["wrong"] + sum(kind["reasons"].values()) == kind["frames"] == 6
        fixes = sum(count for part, count in kind["parts"].items() if not part.endswith("frames"))
        assert fixes == kind["right"] + kind["wrong"]
    assert summary["kinds"]["moved"]["right"] > 0
    assert sum(summary["kinds"][kind]["wrong"] for kind in ("foreign", "mirrored", "ghosts")) == 0
    assert summary["residual_alone_wrong_per_million"] > adversarial.POWER_PER_MILLION
    assert json.loads((tmp_path / "adversarial.json").read_text()) == summary
    assert (tmp_path / "adversarial.png").stat().st_size > 10_000
    assert len(adversarial.table(summary).rows) > 8


@pytest.mark.parametrize(("p", "k"), [(1.0, 0), (0.11, 0), (0.1, 1), (1e-9, 9), (9e-10, 9), (1e-300, 40), (0.0, 40)])
def test_a_decade_ends_where_the_threshold_lets_it_pass(p: float, k: int) -> None:
    assert adversarial.decade(p) == k


def test_a_rate_is_bounded_from_above_though_nothing_happened() -> None:
    assert 2.9 < adversarial.upper_per_million(0, 1_000_000) < 3.1  # the rule of three
    assert 4.6 < adversarial.upper_per_million(1, 1_000_000) < 4.9


def test_what_p_chance_promised_is_set_beside_what_came(tmp_path: Path) -> None:
    summary = chance.measure(tmp_path, 40, 1, 20, 1)
    assert summary["frames"] == 40
    assert 0 < sum(row["fixes"] for row in summary["decades"]) <= 40
    for k, row in enumerate(summary["decades"]):
        assert 0 <= row["wrong"] <= row["fixes"]
        if row["fixes"] and k < chance.BINS - 1:
            assert 10.0 ** -(k + 1) < row["promised"] <= 10.0**-k
    assert len(chance.table(summary).rows) == chance.BINS
    assert (tmp_path / "chance.png").stat().st_size > 10_000


def test_a_decade_with_too_many_wrong_fixes_breaks_the_promise() -> None:
    def result(fixes: int, wrong: int) -> dict[str, dict]:
        row = np.zeros((3, chance.BINS))
        row[:, 2] = fixes, wrong, 0.005 * fixes
        return {"weak/0": {"frames": 5000, **dict(zip(("fixes", "wrong", "promised"), row.tolist(), strict=True))}}

    assert chance.summarised(result(2000, 20))["is_kept"]
    assert not chance.summarised(result(2000, 21))["is_kept"]
    assert chance.summarised(result(900, 90))["is_kept"]  # too few to say
    assert chance.wrong_of_promised(chance.summarised(result(2000, 20))) == pytest.approx(2.0)


def test_the_pair_table_finds_what_trifix_finds() -> None:
    summary = cold_start.measure((60,), 10, 20.0, 1, ("cliquematch", "KISS-Matcher", "Open3D"), Config())
    rows = {row["method"]: row for row in summary["rows"]}
    assert rows["trifix"]["queries"] == rows["pair table"]["queries"] == 10
    assert min(row["success"] for row in rows.values()) > 0.7
    assert max(row["wrong"] for row in rows.values()) == 0
    assert "| 60 | trifix | 10 |" in cold_start.markdown(summary)
    assert [each["than"] for each in summary["ratios"]] == ["pair table"]


@pytest.mark.parametrize("peer", cold_start.PEERS, ids=lambda peer: peer.name)
def test_each_peer_finds_the_pose_of_frames_of_the_map_alone(peer: type) -> None:
    if hasattr(peer, "module"):
        pytest.importorskip(peer.module, reason=f"{peer.name} is not installed")
    world, batch = cold_start.made_queries(np.random.default_rng(2), 50, 6)
    solver = peer(world.map)
    for k in range(6):
        pose = solver(batch.points(k)).pose
        if batch.part[k]:
            assert pose is None
        else:
            assert pose is not None
            assert batch.is_right(k, pose, world.map)


def test_every_metric_of_the_baseline_says_what_it_is() -> None:
    baseline = json.loads(bench.BASELINE.read_text())
    for metric in baseline.values():
        assert set(metric) == {"value", "unit", "direction", "tolerance"}
        assert metric["direction"] in ("lower", "higher")
        assert metric["tolerance"] >= 0


@pytest.mark.parametrize(
    ("direction", "now", "is_good"), [("lower", 1.2, True), ("lower", 1.3, False), ("higher", 0.7, False)]
)
def test_what_is_worse_than_its_tolerance_allows_fails(direction: str, now: float, is_good: bool) -> None:
    baseline = {"a": {"value": 1.0, "unit": "ratio", "direction": direction, "tolerance": 0.25}}
    table, verdict = bench.compared({"a": now}, baseline)
    assert verdict is is_good
    assert table.row_count == 1
    assert bench.compared({}, baseline)[1]  # a peer that is not installed
