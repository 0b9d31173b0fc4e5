"""The quick reader of plain numbers against Python's own `float`, bit by bit."""

from __future__ import annotations

import io

import numpy as np
import pytest

from graphnav.recording.formats import decimals
from graphnav.recording.formats.decimals import read_decimals

WAYS = ("{!r}", "{:.3f}", "{:.12f}", "{:.0f}", "{:.9g}", "{:.16f}", "{:.20g}")


def cells(count: int) -> list[str]:
    """Numbers of all sizes, written in many ways."""
    rng = np.random.default_rng(3)
    values = rng.uniform(-1.0, 1.0, count) * 10.0 ** rng.integers(-9, 10, count)
    ways = rng.integers(0, len(WAYS), count)
    return [WAYS[way].format(float(value)) for way, value in zip(ways, values, strict=True)]


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_every_number_is_the_one_that_float_reads(monkeypatch: pytest.MonkeyPatch, line_end: str) -> None:
    monkeypatch.setattr(decimals, "_BLOCK_SIZE", 5000)  # many blocks, which end anywhere
    monkeypatch.setattr(decimals, "_SLAB", 700)
    written = [*cells(7993), "-0.0", "-.5", "5.", "007", "9007199254740993", "0.1234567890123456", "nan"]
    text = line_end.join(",".join(written[k : k + 4]) for k in range(0, len(written), 4))
    expected = np.array([float(cell) for cell in written]).reshape(-1, 4)
    found = np.array(read_decimals(io.BytesIO(text.encode()), 4, (3, 0, 1))[0])
    np.testing.assert_array_equal(found.view(np.int64), np.ascontiguousarray(expected[:, [3, 0, 1]].T).view(np.int64))


def test_column_without_points() -> None:
    found, _ = read_decimals(io.BytesIO(b"1,2.5,-3\n40,0.25,0\n"), 3, (0, 1, 2))
    np.testing.assert_array_equal(found, [[1, 40], [2.5, 0.25], [-3, 0]])


@pytest.mark.parametrize(
    "text", ["1,2\n3\n", "1,2\n3,4,5", "1,,2", "1,x", "1,1.2.3", "1,-", "1,--2", "1,2-3", "1,2\n\n3,4", "1, 2", '1,"2"']
)
def test_anything_else_is_left_to_others(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - NumPy's own among them
        read_decimals(io.BytesIO(text.encode()), 2, (0, 1))


def test_no_lines() -> None:
    found, cut = read_decimals(io.BytesIO(b""), 3, (0, 2))
    assert [len(column) for column in found] == [0, 0]
    assert not cut
