"""`trifix live` as a stranger meets it: a replay gives what `trifix run --online` gives, and stopping loses nothing."""

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from constellations import PARALLEL
from test_cli import SMALL, command, lines, rows, trifix
from trifix.files.calibrations import write_rig

SAME = {"summary.json", "timings.csv", "report.html"}  # all but these


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that holds images, dots and points."""
    room = tmp_path_factory.mktemp("recorded")
    for level, count in (("points", 40), ("images", 4)):
        done = trifix("simulate", "demo", "-o", room / level, "--level", level, "--frames", count)
        assert done.code == 0, done.stderr
    shutil.copytree(SMALL / "recording", room / "dots" / "recording")
    return room


@pytest.mark.parametrize("level", ["points", "dots", "images"])
def test_a_replay_without_loss_writes_the_same_bytes_as_an_online_run(
    recording: Path, level: str, tmp_path: Path
) -> None:
    source = recording / level / "recording"
    once = trifix("run", source, "-o", tmp_path / "run", "--online")
    assert once.code == 0, once.stderr
    live = trifix("live", "--replay", source, "-o", tmp_path / "live", "--speed", "max", "--no-viewer", "--from", level)
    assert live.code == 0, live.stderr
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert {path.name for path in (tmp_path / "live").iterdir()} == files
    for name in sorted(files - SAME):
        assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "run" / name).read_bytes(), name
    assert len(lines(tmp_path / "live" / "trajectory.tum")) > 2
    summary = json.loads((tmp_path / "live" / "summary.json").read_text())
    assert (summary["dropped"], summary["finished"], summary["is_online"]) == (0, True, True)
    assert "Positioned." in live.stderr


def test_each_map_has_its_folder_and_its_poses(recording: Path, tmp_path: Path) -> None:
    source, maps = recording / "points" / "recording", tmp_path / "maps"
    assert trifix("run", source, "-o", maps / "head", "--online").code == 0
    shutil.copytree(maps / "head", maps / "bust")
    with (maps / "bust" / "map.csv").open(encoding="utf-8") as file:
        table = list(csv.reader(file))
    at = table[0].index("x_mm")
    moved = [table[0], *([*row[:at], str(float(row[at]) + 1000), *row[at + 1 :]] for row in table[1:])]
    (maps / "bust" / "map.csv").write_text("".join(",".join(row) + "\n" for row in moved), encoding="utf-8")
    options = ("--speed", "max", "--no-viewer", "--json")
    both = ("--map", maps / "head" / "map.csv", "--map", maps / "bust" / "map.csv")
    done = trifix("live", "--replay", source, "-o", tmp_path / "out", *options, *both)
    assert done.code == 0, done.stderr
    told = json.loads(done.stdout)
    assert set(told) == {"head", "bust"}
    assert told["head"]["positioned"] == told["bust"]["positioned"] > 30
    head = np.array(rows(tmp_path / "out" / "head" / "poses.csv", "x_mm", "y_mm", "z_mm"), dtype=float)
    bust = np.array(rows(tmp_path / "out" / "bust" / "poses.csv", "x_mm", "y_mm", "z_mm"), dtype=float)
    np.testing.assert_allclose(bust - head, np.tile([1000.0, 0.0, 0.0], (len(head), 1)), atol=1e-3)
    again = trifix("live", "--replay", source, "-o", tmp_path / "other", *options, *both[:2], *both[:2])
    assert again.code == 1
    assert "another map is called head as well" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "Name either two cameras (--left, --right), or one (--side-by-side), or a --replay."),
        (["--left", "0"], "Name both cameras, --left and --right."),
        (["--left", "0", "--right", "1"], "Cameras need a --calibration; a recording has its own."),
        (["--replay", "r", "--calibration", "c.yaml"], "Cameras need a --calibration; a recording has its own."),
        (["--replay", "r", "--left", "0"], "Name either two cameras"),
        (["--replay", "r", "--speed", "0"], "--speed must be positive and finite, or max."),
        (["--replay", "r", "--map-mode", "grow"], "--map-mode says what becomes of a given map: name it with --map."),
    ],
)
def test_what_does_not_fit_together_is_a_usage_error(arguments: list[str], text: str) -> None:
    done = trifix("live", "-o", "out", *arguments)
    assert done.code == 2
    assert text in done.stderr
    assert done.stderr.count("\n") == 1


def test_what_is_missing_is_bad_input(tmp_path: Path) -> None:
    done = trifix("live", "-o", tmp_path / "out", "--left", "61", "--right", "62", "--calibration", "no.yaml")
    assert done.code == 1
    done = trifix("live", "-o", tmp_path / "out", "--replay", SMALL / "recording", "--publish", "here", "--no-viewer")
    assert done.code == 1
    assert "here is no address to publish at" in done.stderr


def test_a_viewer_that_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "trifix.outputs.viewer", raising=False)
    done = trifix("live", "-o", tmp_path / "out", "--replay", SMALL / "recording", "--speed", "max")
    assert done.code == 1
    assert (
        done.stderr
        == 'trifix: The viewer needs an extra: pip install "trifix[viewer]". Without a viewer: --no-viewer.\n'
    )


def clip(path: Path, seconds: float) -> Path:
    """A video of noise and three dots."""
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (1280, 1024), isColor=False)
    for k in range(int(30 * seconds)):
        small = rng.integers(90, 110, (256, 320)).astype(np.uint8)
        image = cv2.resize(small, (1280, 1024), interpolation=cv2.INTER_NEAREST)
        cv2.circle(image, (300 + k % 30, 400), 9, 20, -1)
        writer.write(image)
    writer.release()
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopping_ends_a_live_run_whole(tmp_path: Path, number: signal.Signals) -> None:
    video = clip(tmp_path / "noise.avi", 1.0)
    shutil.copy(video, tmp_path / "other.avi")
    write_rig(PARALLEL, tmp_path / "calibration.yaml")
    out = tmp_path / "out"
    # a stream that begins anew whenever it has ended
    sources = ("--left", f"file://{video}", "--right", f"file://{tmp_path / 'other.avi'}", "--max-skew-ms", "1000")
    arguments = command("live", "-o", out, *sources, "--calibration", tmp_path / "calibration.yaml", "--no-viewer")
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        while not (out / "frames.csv").exists() or len(lines(out / "frames.csv")) < 20:
            assert running.poll() is None, running.communicate()
            time.sleep(0.05)
        running.send_signal(number)
        printed, complaint = running.communicate(timeout=120)
    assert running.returncode == 0, complaint
    summary = json.loads((out / "summary.json").read_text())
    assert summary["finished"] is True
    assert summary["frames"] == len(rows(out / "frames.csv", "frame")) >= 19
    assert (out / "report.html").stat().st_size > 10_000
    assert "report" in printed


def test_an_interrupted_replay_keeps_what_was_judged_and_is_not_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = command("live", "--replay", SMALL / "recording", "--speed", "0.1", "-o", out, "--no-viewer")
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        while not (out / "frames.csv").exists() or len(lines(out / "frames.csv")) < 3:
            assert running.poll() is None, running.communicate()
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        _, complaint = running.communicate(timeout=120)
    assert running.returncode == 130, complaint
    assert "interrupted; what was finished until then is whole." in complaint
    assert json.loads((out / "summary.json").read_text())["finished"] is False
    positioned = [row for row in rows(out / "frames.csv", "frame", "status") if row[1] == "positioned"]
    assert len(lines(out / "trajectory.tum")) == len(positioned)


def test_the_example_of_pushed_frames_runs(tmp_path: Path) -> None:
    shutil.copytree(SMALL, tmp_path / "demo")
    example = Path(__file__).parent.parent / "examples" / "02_push_frames.py"
    done = subprocess.run([sys.executable, example], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 40
