"""The command line as a stranger meets it: what it prints, where, and with which exit code it leaves."""

import csv
import inspect
import io
import json
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import pytest
from cyclopts import App

from trifix import cli
from trifix.console import Json

SMALL = Path(__file__).parent / "data" / "small"


@dataclass(frozen=True)
class Outcome:
    code: int
    stdout: str
    stderr: str


def trifix(*arguments: object) -> Outcome:
    """What the program does with these arguments, in this process."""
    stdout, stderr, before = io.StringIO(), io.StringIO(), signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(stdout), redirect_stderr(stderr):
        patch.setattr(sys, "argv", ["trifix", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as leaving:
            code = int(str(leaving.code))
        finally:
            signal.signal(signal.SIGTERM, before)
    return Outcome(code, stdout.getvalue(), stderr.getvalue())


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "trifix", *map(str, arguments)]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the small recording was positioned: its results, and what was printed."""
    room = tmp_path_factory.mktemp("run")
    done = trifix("run", SMALL / "recording", "-o", room / "results")
    assert done.code == 0, done.stderr
    (room / "printed.txt").write_text(done.stdout, encoding="utf-8")
    return room


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that takes some seconds to position."""
    room = tmp_path_factory.mktemp("long")
    done = trifix("simulate", "demo", "-o", room, "--frames", 800)
    assert done.code == 0, done.stderr
    return room / "recording"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--help"], 0),
        (["run", "--help"], 0),
        (["--version"], 0),
        (["runn"], 2),
        (["run", "recording"], 2),
        (["run", "recording", "-o", "out", "--from", "video"], 2),
        (["run", "recording", "-o", "out", "--set", "match.max_depth_mm"], 2),
        (["simulate", "head", "-o", "out", "--seed", "one"], 2),
    ],
)
def test_help_and_usage_errors_load_no_numerics(arguments: list[str], code: int) -> None:
    program = (
        "import sys, trifix.cli\n"
        f"sys.argv = ['trifix', *{arguments}]\n"
        "try: trifix.cli.main()\n"
        "except SystemExit as leaving: code = leaving.code\n"
        "else: code = 0\n"
        "print('\\n', code, [name for name in ('numpy', 'cv2', 'numba', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].strip() == f"{code} []"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["runn"], 'Unknown command "runn". Did you mean "run"?'),
        (["run", "here", "-o", "out", "--onlin"], "Unknown option: --onlin. Did you mean --online?"),
        (
            ["run", "here", "-o", "out", "--from", "video"],
            '"video" for --from. Choose from: "images", "dots", "points".',
        ),
        (["run", "here", "-o", "out", "--sigma-px", "small"], 'unable to convert "small" into float.'),
        (["run", "here", "-o", "out", "--map-mode", "frozen"], "--map-mode says what becomes of a given map: name it"),
        (["run", "here", "-o", "out", "--set", "match"], '"match" has no value; write stage.key=value.'),
    ],
)
def test_a_usage_error_is_one_sentence_and_code_2(arguments: list[str], text: str) -> None:
    done = trifix(*arguments)
    assert done.code == 2
    assert done.stdout == ""
    assert done.stderr.startswith("trifix: ")
    assert done.stderr.count("\n") == 1
    assert text in done.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["run", "nowhere", "-o", "out"], "nowhere is not a folder, expected a recording."),
        (["run", SMALL / "recording", "-o", "out", "--map", "nowhere.csv"], "nowhere.csv does not exist."),
        (["run", SMALL / "recording", "-o", "out", "--config", "nowhere.toml"], "nowhere.toml does not exist."),
        (
            ["run", SMALL / "recording", "-o", "out", "--sigma-px", "-1"],
            "command line: noise.sigma_px is -1.0, expected",
        ),
        (["run", SMALL / "recording", "-o", "out", "--sigma-px", "nan"], "noise.sigma_px is nan, expected a finite"),
        (
            ["config", "--set", "detect.min_contrast=-3"],
            "command line: detect.min_contrast is -3.0, expected a fraction",
        ),
        (["config", "--set", "match.max_dept_mm=900"], "did you mean match.max_depth_mm?"),
        (["config", "--set", "detect.polarity=green"], '"green", expected one of "auto", "dark", "bright".'),
        (["simulate", "hed", "-o", "out"], "did you mean 'head'?"),
        (["compare", SMALL, "nowhere"], "holds no summary.json: expected results that `trifix run` wrote."),
    ],
)
def test_bad_input_is_one_sentence_and_code_1(
    arguments: list[object], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = trifix(*arguments)
    assert done.code == 1
    assert done.stdout == ""
    assert done.stderr.startswith("trifix: ")
    assert done.stderr.count("\n") == 1
    assert text in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_version_is_that_of_the_package() -> None:
    assert trifix("--version").stdout == f"trifix {cli.trifix.__version__}\n"


def test_levels_are_those_of_recordings() -> None:
    from trifix.files.recordings import Level

    assert get_args(cli.Level) == get_args(Level)


def test_config_prints_what_it_was_told(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[match]\nmax_depth_mm = 900\n[detect]\npolarity = 'dark'\n", encoding="utf-8")
    printed = trifix("config", "--config", file, "--set", "detect.polarity=bright").stdout
    assert "max_depth_mm = 900.0\n" in printed
    assert 'polarity = "bright"\n' in printed
    file.write_text(printed, encoding="utf-8")
    assert trifix("config", "--config", file).stdout == printed


def test_a_run_writes_its_results_and_says_what_it_found(room: Path) -> None:
    printed = (room / "printed.txt").read_text(encoding="utf-8")
    assert "positioned" in printed
    assert "noise" in printed
    assert "report.html" in printed.replace("\n", "")
    assert (room / "results" / "report.html").stat().st_size > 1000


def commands(app: App, path: tuple[str, ...] = ()) -> Iterator[tuple[str, App]]:
    """Every command that does something, those of groups among them."""
    for name in app:
        if not name.startswith("-"):
            yield from commands(app[name], (*path, name))
    if app.default_command is not None and path:
        yield " ".join(path), app


def test_the_readme_lists_every_command_in_the_order_of_the_help() -> None:
    readme = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `trifix ([a-z]+(?: paper)?)", readme, re.MULTILINE)
    assert listed == [name for name, _ in commands(cli.app)]
    shown = re.findall(r"^│ ([a-z]+) ", trifix("--help").stdout, re.MULTILINE)
    assert shown == [name.split()[0] for name in listed]


def test_every_command_can_answer_in_json():
    found = dict(commands(cli.app))
    assert {"demo", "run", "live", "view", "experiment paper", "warmup"} <= found.keys()
    for name, command in found.items():
        assert command.default_command is not None
        option = inspect.signature(command.default_command).parameters.get("json")
        assert option is not None, f"{name} lacks the option --json: see src/trifix/console.py"
        assert (option.annotation, option.default) == (Json, False), name


def told(*arguments: object) -> dict[str, object]:
    """The one object that a command prints as JSON."""
    done = trifix(*arguments, "--json")
    assert done.code == 0, done.stderr
    record = json.loads(done.stdout)
    assert isinstance(record, dict)
    return record


def test_a_run_told_as_json_is_its_summary_and_where_the_report_is(tmp_path: Path):
    record = told("run", SMALL / "recording", "-o", tmp_path)
    assert record.pop("report") == str(tmp_path / "report.html")
    assert record == json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))


def test_an_evaluation_told_as_json_holds_its_figures(room: Path):
    record = told("evaluate", room / "results", SMALL / "truth")
    assert (record["positioned"], record["misidentified"]) == (40, [])


def test_two_runs_are_compared_in_words_in_json_and_on_a_page(room: Path, tmp_path: Path):
    out, page = room / "results", tmp_path / "page.html"
    done = trifix("compare", out, out, "-o", page)
    assert (done.code, done.stderr) == (0, "")
    assert "40 by both" in done.stdout
    assert page.exists()
    record = told("compare", out, out)
    assert (record["positioned_by_both"], record["is_aligned"]) == (40, False)


def test_options_told_as_json_are_those_of_the_toml():
    record = told("config", "--set", "match.max_depth_mm=900")
    assert record == tomllib.loads(trifix("config", "--set", "match.max_depth_mm=900").stdout)


def test_a_recording_told_as_json_says_where_it_is(tmp_path: Path):
    record = told("simulate", "demo", "-o", tmp_path, "--frames", 2)
    assert record["recording"] == str(tmp_path / "recording")


def test_a_mistake_is_a_sentence_in_json_mode_too():
    done = trifix("run", "nowhere", "-o", "out", "--json")
    assert (done.code, done.stdout) == (1, "")
    assert done.stderr == "trifix: nowhere is not a folder, expected a recording.\n"


def test_results_are_compared_with_the_truth(room: Path) -> None:
    done = trifix("evaluate", room / "results", SMALL / "truth")
    assert done.code == 0, done.stderr
    assert "misidentified" in done.stdout


def test_what_counts_as_wrong_can_be_said(room: Path) -> None:
    done = trifix("evaluate", room / "results", SMALL / "truth", "--wrong-mm", 7, "--wrong-deg", 0.25)
    assert done.code == 0, done.stderr
    assert "7 mm or 0.25°" in done.stdout


@pytest.mark.parametrize("limit", ["--wrong-mm", "--wrong-deg"])
@pytest.mark.parametrize("value", ["0", "nan", "inf"])
def test_an_impossible_limit_is_a_usage_error(limit: str, value: str) -> None:
    done = trifix("evaluate", "results", "truth", limit, value)
    assert (done.code, done.stdout) == (2, "")
    assert done.stderr == "trifix: --wrong-mm and --wrong-deg must be positive and finite.\n"


def test_a_given_map_without_targets_is_refused(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("id,x_mm,y_mm,z_mm\n", encoding="utf-8")
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out", "--map", tmp_path / "map.csv")
    assert done.code == 1
    assert f"{tmp_path / 'map.csv'}: found no target, expected at least three; choose" in done.stderr


def test_the_summary_knows_the_name_of_the_folder_one_is_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SMALL / "recording")
    assert trifix("run", ".", "-o", tmp_path / "out").code == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["recording"] == "recording"


def test_a_simulated_recording_can_be_positioned(tmp_path: Path) -> None:
    made = trifix("simulate", "demo", "-o", tmp_path, "--frames", 5, "--seed", 3)
    assert (made.code, made.stdout) == (0, "")
    assert trifix("run", tmp_path / "recording", "-o", tmp_path / "results").code == 0
    again = trifix("simulate", "demo", "-o", tmp_path, "--frames", 5)
    assert again.code == 1
    assert "exists already: choose another folder" in again.stderr


def test_a_second_demo_positions_the_recording_of_the_first(tmp_path: Path) -> None:
    shutil.copytree(SMALL, tmp_path / "demo")
    done = trifix("demo", "-o", tmp_path / "demo")
    assert done.code == 0, done.stderr
    assert "40  of 40 frames" in done.stdout
    assert (tmp_path / "demo" / "results" / "report.html").exists()


def test_warming_up_reaches_every_kernel_module() -> None:
    kernels = list((Path(cli.__file__).parent / "kernels").glob("[!_]*.py"))
    done = trifix("warmup")
    assert done.code == 0
    assert f"{len(kernels)}/{len(kernels)}" in done.stderr


def test_a_given_map_is_left_as_it_is(room: Path, tmp_path: Path) -> None:
    done = trifix(
        "run",
        SMALL / "recording",
        "-o",
        tmp_path / "again",
        "--map",
        room / "results" / "map.csv",
        "--map-mode",
        "frozen",
    )
    assert done.code == 0, done.stderr
    assert rows(tmp_path / "again" / "map.csv", "id") == rows(room / "results" / "map.csv", "id")


def test_the_same_recording_gives_the_same_bytes(room: Path, tmp_path: Path) -> None:
    first, again = room / "results", tmp_path / "again"
    subprocess.run(command("run", SMALL / "recording", "-o", again), check=True)
    names = {path.name for path in first.iterdir()}
    assert names == {path.name for path in again.iterdir()}
    for name in names - {"timings.csv", "summary.json", "report.html"}:
        assert (first / name).read_bytes() == (again / name).read_bytes(), name


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "file" / "results")
    assert done.code == 1
    assert str(tmp_path / "file") in done.stderr
    assert "Traceback" not in done.stderr


def test_a_reader_that_goes_away_is_no_crash() -> None:
    process = subprocess.Popen(command("config"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == "trifix: whoever read the output has gone, so not all of it was printed.\n"
    assert process.wait() == 1


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_whole_lines_and_code_130(
    sent: signal.Signals, long_recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "results"
    process = subprocess.Popen(
        command("run", long_recording, "-o", out), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None and (not (out / "frames.csv").exists() or len(lines(out / "frames.csv")) < 20):
        time.sleep(0.02)
    process.send_signal(sent)
    _, stderr = process.communicate()
    assert process.returncode == 130, stderr
    assert "interrupted" in stderr
    assert "Traceback" not in stderr
    frames = rows(out / "frames.csv", "frame", "status")
    assert 19 <= len(frames) < 800
    positioned = [(frame,) for frame, status in frames if status == "positioned"]
    assert rows(out / "poses.csv", "frame")[: len(positioned)] == positioned


@pytest.mark.parametrize(("example", "says"), [("00_first_fix.py", "residual"), ("01_how_far_off.py", "ahead")])
def test_examples_run(example: str, says: str, tmp_path: Path) -> None:
    shutil.copytree(SMALL, tmp_path / "demo")
    program = Path(__file__).parent.parent / "examples" / example
    done = subprocess.run([sys.executable, program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(says) == 40


def test_the_readme_shows_the_first_example() -> None:
    root = Path(__file__).parent.parent
    code = (root / "examples" / "00_first_fix.py").read_text(encoding="utf-8").split('"""', 2)[2].strip()
    assert f"```python\n{code}\n```" in (root / "README.md").read_text(encoding="utf-8")


def lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def rows(path: Path, *columns: str) -> list[tuple[str, ...]]:
    """Columns of a table, each of whose lines must be whole."""
    text = path.read_text(encoding="utf-8")
    assert text.endswith("\n")
    table = list(csv.DictReader(text.splitlines()))
    assert all(None not in row and None not in row.values() for row in table)
    return [tuple(row[column] for column in columns) for row in table]


# --- the adjustment --------------------------------------------------------------------------------------------------

RESULTS = ("poses.csv", "trajectory.tum", "map.csv", "frames.csv", "sightings.csv")


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


@pytest.fixture(scope="module")
def unadjusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("unadjusted") / "results"
    done = trifix("run", SMALL / "recording", "-o", out, "--no-adjust")
    assert done.code == 0, done.stderr
    return out


def test_a_run_ends_with_an_adjustment_and_says_so(room: Path, unadjusted: Path) -> None:
    told = json.loads((room / "results" / "summary.json").read_text())["adjustment"]
    assert told["rms_after"] < told["rms_before"]
    assert told["observations"] > 100
    assert "adjusted, rms" in (room / "printed.txt").read_text(encoding="utf-8")
    assert "All adjusted together" in (room / "results" / "report.html").read_text(encoding="utf-8")
    assert json.loads((unadjusted / "summary.json").read_text())["adjustment"] is None
    assert bytes_of(unadjusted)["poses.csv"] != bytes_of(room / "results")["poses.csv"]
    status = [{row["frame"]: row["status"] for row in frames_in(out)} for out in (unadjusted, room / "results")]
    assert status[0] == status[1]


def frames_in(out: Path) -> list[dict[str, str]]:
    with (out / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_an_interrupt_while_adjusting_leaves_the_results_before_it_whole(
    unadjusted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from trifix import bundle

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(bundle, "adjust", interrupted)
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out")
    assert done.code == 130
    assert bytes_of(tmp_path / "out") == bytes_of(unadjusted)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert not summary["finished"]
    assert summary["frames"] == len(frames_in(unadjusted))


def test_where_nothing_can_be_adjusted_the_run_is_complete_and_says_why(
    unadjusted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from trifix import bundle

    monkeypatch.setattr(bundle, "MOST_TARGETS", 2)
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out")
    assert done.code == 0
    assert "not adjusted" in done.stdout
    assert bytes_of(tmp_path / "out") == bytes_of(unadjusted)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["finished"]
    assert "the limit is 2" in summary["not_adjusted"]


def test_a_scale_bar_of_an_unknown_target_is_told_when_the_results_are_whole(unadjusted: Path, tmp_path: Path) -> None:
    bars = tmp_path / "bars.csv"
    bars.write_text("target_a,target_b,length_mm,sigma_mm\n0,4711,100,0.1\n")
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out", "--scale-bars", bars)
    assert done.code == 1
    assert done.stderr.splitlines()[-1].endswith("target 4711 is not in the map: name targets by the id of map.csv.")
    assert bytes_of(tmp_path / "out") == bytes_of(unadjusted)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["finished"]


def test_control_targets_and_scale_bars_of_an_earlier_run_hold(room: Path, tmp_path: Path) -> None:
    with (room / "results" / "map.csv").open(newline="") as file:
        targets = [row for row in csv.DictReader(file) if row["state"] == "trusted"][:5]
    control = tmp_path / "control.csv"
    shifted = "\n".join(f"{t['id']},{float(t['x_mm']) + 1000},{t['y_mm']},{t['z_mm']},0.05" for t in targets)
    control.write_text(f"id,x_mm,y_mm,z_mm,sigma_mm\n{shifted}\n")
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out", "--control", control)
    assert done.code == 0, done.stderr
    with (tmp_path / "out" / "map.csv").open(newline="") as file:
        places = {row["id"]: float(row["x_mm"]) for row in csv.DictReader(file)}
    for t in targets:
        assert abs(places[t["id"]] - float(t["x_mm"]) - 1000) < 0.2


def test_a_refined_rig_is_a_calibration_again(tmp_path: Path) -> None:
    from trifix.files.calibrations import read_rig

    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out", "--refine-rig")
    assert done.code == 0, done.stderr
    assert "rig, moved by" in done.stdout
    given, refined = (read_rig(folder / "calibration.yaml") for folder in (SMALL / "recording", tmp_path / "out"))
    assert refined.left.fu_px != given.left.fu_px
    assert abs(refined.baseline_mm - given.baseline_mm) < 1e-6
    assert trifix("run", SMALL / "recording", "-o", tmp_path / "out", "--no-adjust").code == 0
    assert not (tmp_path / "out" / "calibration.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--online", "--refine-rig"], "--refine-rig needs the adjustment of the whole recording, which was left out."),
        (["--no-adjust", "--scale-bars", "b.csv"], "--scale-bars needs the adjustment of the whole recording"),
        (["--map", "m.csv", "--control", "c.csv"], "--map and --control both say what the world is: choose one."),
    ],
)
def test_options_that_contradict_each_other_are_a_usage_error(arguments: list[str], text: str, tmp_path: Path) -> None:
    done = trifix("run", SMALL / "recording", "-o", tmp_path / "out", *arguments)
    assert done.code == 2
    assert text in done.stderr


def test_a_rig_is_not_refined_by_points(tmp_path: Path) -> None:
    assert trifix("simulate", "statue", "-o", tmp_path, "--level", "points", "--frames", 3).code == 0
    done = trifix("run", tmp_path / "recording", "-o", tmp_path / "out", "--refine-rig")
    assert done.code == 1
    assert "has points only: a rig is refined where one saw the dots of all frames." in done.stderr
