"""What ctrl-C and SIGTERM do to a command: what was finished until then stays whole. Knows no command."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

INTERRUPTED = "interrupted; what was finished until then is whole."
"""What an interrupted command says."""


@contextmanager
def between_frames() -> Iterator[Callable[[], None]]:
    """Lets an interrupt wait until what is yielded is called, as compiled code does not survive one.

    A second interrupt does not wait.
    """

    def end() -> None:  # an exception would end in the middle of compiled code, print in that of a line
        cursor = "\x1b[?25h\n" if os.isatty(2) else ""  # which the progress bar hides
        os.write(2, f"{cursor}trifix: {INTERRUPTED}\n".encode())
        os._exit(130)

    with _noted(end) as is_told:

        def stop_if_told() -> None:
            if is_told():
                raise KeyboardInterrupt

        yield stop_if_told


@contextmanager
def noted() -> Iterator[Callable[[], bool]]:
    """Lets an interrupt do nothing but be noted: what is yielded says whether one has come. A second one interrupts."""

    def end() -> None:
        raise KeyboardInterrupt

    with _noted(end) as is_told:
        yield is_told


def comes_of_interrupt(error: BaseException | None) -> bool:
    """Whether an interrupt is behind an error: inside compiled code, one looks like a SystemError."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt)
        or comes_of_interrupt(error.__cause__)
        or comes_of_interrupt(error.__context__)
    )


@contextmanager
def _noted(at_second: Callable[[], None]) -> Iterator[Callable[[], bool]]:
    told: list[int] = []

    def note(number: int, frame: object) -> None:
        told.append(number)
        if len(told) > 1:
            at_second()

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(told)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
