"""Poses as datagrams: what they say, that the example receives them, and that nobody is waited for."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made_steps import steps

from trifix.errors import ConfigError
from trifix.live import Rates
from trifix.outputs.publish import Publisher, datagram
from trifix.records import Fix, NoFix

EXAMPLES = Path(__file__).parents[2] / "examples"
RATES = Rates(60.0, 12.5, 3)


def test_a_datagram_says_what_is_known_and_null_for_what_is_not() -> None:
    made = list(steps(60))
    first, positioned = made[0], made[7]
    refused = next(step for step in made if isinstance(step.fix, NoFix) and np.isnan(step.fix.p_chance))
    told = json.loads(datagram("cup", positioned, RATES))
    assert isinstance(positioned.fix, Fix)
    assert (told["body"], told["frame"], told["status"], told["reason"]) == ("cup", 7, "positioned", None)
    assert told["timestamp_ns"] == positioned.frame.timestamp_ns
    assert told["position_mm"] == positioned.fix.T_world_sensor.t_mm.tolist()
    assert told["quaternion_xyzw"] == positioned.fix.T_world_sensor.quaternion_xyzw.tolist()
    assert told["covariance"] == positioned.fix.cov.tolist()
    assert told["p_chance"] == positioned.fix.p_chance
    assert told["latency_ms"] == 12.5
    told = json.loads(datagram("", first, RATES))
    assert (told["reason"], told["p_chance"]) == ("defines_world", None)
    told = json.loads(datagram("", refused, RATES))
    assert isinstance(refused.fix, NoFix)
    assert (told["status"], told["reason"]) == ("refused", refused.fix.why.name)
    assert told["position_mm"] is told["covariance"] is told["p_chance"] is None


def test_a_datagram_fits_into_one_packet() -> None:
    assert max(len(datagram("a body", step, RATES)) for step in steps(60)) < 1472


def test_the_example_receives_every_frame() -> None:
    made = list(steps(35))
    command = [sys.executable, EXAMPLES / "receive_poses.py", "0", str(len(made))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as receiver:
        assert receiver.stdout is not None
        port = int(receiver.stdout.readline().split()[-1])
        publisher = Publisher(f"udp://:{port}")
        for step in made:
            publisher.send("cup", step, RATES)
        publisher.close()
        printed, _ = receiver.communicate(timeout=60)
    lines = printed.splitlines()
    assert [line.split()[:2] for line in lines] == [[str(k), "cup"] for k in range(35)]
    assert lines[30] == "30 cup refused: too_few_points"
    fix = made[7].fix
    assert isinstance(fix, Fix)
    x, y, z = fix.T_world_sensor.t_mm
    assert lines[7].startswith(f"7 cup {x:.2f} {y:.2f} {z:.2f} mm, sigma 0.224 mm")
    assert publisher.lost == 0


def test_who_does_not_listen_is_not_waited_for() -> None:
    publisher = Publisher("udp://127.0.0.1:9")  # where nobody listens
    for step in steps(5):
        publisher.send("", step, RATES)
    publisher.close()
    publisher.send("", next(iter(steps(1))), RATES)
    assert publisher.lost == 1


@pytest.mark.parametrize("url", ["localhost:5005", "udp://", "udp://:notaport", "http://:80", "udp://:99999", ""])
def test_what_is_no_address_is_refused_with_an_example(url: str) -> None:
    with pytest.raises(
        ConfigError, match=r"is no address to publish at, expected udp://HOST:PORT, such as udp://:5005"
    ):
        Publisher(url)


def test_an_unknown_host_is_named() -> None:
    with pytest.raises(ConfigError, match=r"the host nowhere\.invalid is not known"):
        Publisher("udp://nowhere.invalid:5005")


@pytest.mark.parametrize("name", ["ros2_node.py", "genicam_camera.py", "02_push_frames.py"])
def test_examples_are_python(name: str) -> None:
    compile((EXAMPLES / name).read_text(encoding="utf-8"), name, "exec")
