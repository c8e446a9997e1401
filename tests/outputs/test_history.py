"""What is remembered of frames without end."""

import pytest

from trifix.outputs.history import Thinned


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 16, 17, 1000, 4097])
def test_frames_are_thinned_evenly_from_the_first_on(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Thinned, "most", 8)
    kept = Thinned[int]()
    for k in range(count):
        kept.add(k)
    stride = kept.items[1] - kept.items[0] if len(kept.items) > 1 else 1
    assert kept.items == list(range(0, count, stride))
    assert len(kept.items) == count if count <= 8 else 4 < len(kept.items) <= 8
