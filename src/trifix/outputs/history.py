"""What is remembered of the frames of a run that may never end. Knows no Step."""

from typing import Generic, TypeVar

T = TypeVar("T")


class Thinned(Generic[T]):
    """One item a frame: of every frame up to ``most``, then of every second, fourth ... from the first on."""

    most = 1 << 13
    """Items that are kept, an even number."""

    def __init__(self) -> None:
        self.items: list[T] = []
        """What is kept, in the order of the frames."""
        self._seen, self._stride = 0, 1

    def add(self, item: T) -> None:
        """Take note of the next frame's."""
        if self._seen % self._stride == 0:
            if len(self.items) == self.most:
                del self.items[1::2]
                self._stride *= 2
            self.items.append(item)
        self._seen += 1
