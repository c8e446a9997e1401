"""What an interrupt does."""

import signal
import subprocess
import sys

import pytest

from trifix.interrupts import INTERRUPTED, comes_of_interrupt, noted


def test_an_interrupt_is_found_behind_other_errors() -> None:
    inner, outer = ValueError(), SystemError()
    inner.__context__ = KeyboardInterrupt()
    outer.__cause__ = inner
    assert comes_of_interrupt(outer)
    assert not comes_of_interrupt(SystemError())


def test_a_second_interrupt_ends_at_once() -> None:
    program = (
        "import signal\nfrom trifix.interrupts import between_frames\n"
        "with between_frames():\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    print('waits', flush=True)\n"
        "    signal.raise_signal(signal.SIGTERM)\n"
        "    print('goes on', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, "waits\n")
    assert done.stderr == f"trifix: {INTERRUPTED}\n"


def test_a_noted_interrupt_does_nothing_and_a_second_one_interrupts() -> None:
    before = signal.getsignal(signal.SIGINT)
    with noted() as is_told:
        assert not is_told()
        signal.raise_signal(signal.SIGTERM)
        assert is_told()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
