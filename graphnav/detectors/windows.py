"""Blocks of rows, running sums over them, and a low-passed copy of the IMU, common to all windowed statistics.

Window sums are differences of one running sum (O(1) per window, whatever its length). Rows are first summed in blocks,
so that an hour at 200 Hz becomes 180 000 blocks; a low-pass filter far below an engine's lowest line then leaves the
motion of the body itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from graphnav.core.rotation import Array
from graphnav.core.running import sum_rows
from graphnav.recording import Imu

BLOCK_RATE = 50.0  # Hz, lowest rate of the blocks
WINDOW_STEP = 0.1  # s between windows
_KERNEL_LENGTH = 0.4  # s, length of the low-pass filter
_LOW_RATE = 10.0  # Hz, rate of the low-passed rows
_LONGEST_BLOCK_GAP = 0.2  # s by which a block may last too long and still be valid


@dataclass(frozen=True)
class BlockMeans:
    """Means over blocks of rows, [force, rate, |force|, |force|^2, |rate|^2] with force (3) and rate (3)."""

    t: Array  # (K,) s, middle of each block
    end: Array  # (K,) s, its end
    mean: Array  # (K, 9)
    period: float  # s per block
    row_period: float  # s per row of the IMU
    whole: Array  # (K,) bool, False where there is a gap in the block or before it

    @property
    def force(self) -> Array:
        """(K, 3) m/s^2"""
        return self.mean[:, :3]

    @property
    def rate(self) -> Array:
        """(K, 3) rad/s"""
        return self.mean[:, 3:6]


def average_blocks(imu: Imu, row_period: float) -> BlockMeans:
    """Blocks of at most 1/`BLOCK_RATE` s; rows after the last complete block are dropped."""
    size = max(1, int(1.0 / (BLOCK_RATE * row_period) + 1e-6))
    count = len(imu.t) // size
    n = count * size
    mean = np.empty((count, 9))
    for values, at, square in ((imu.accel, 0, 7), (imu.gyro, 3, 8)):
        rows = values[:n].reshape(count, size, 3)
        mean[:, at : at + 3] = np.einsum("kij->kj", rows) / size
        norms = np.einsum("nj,nj->n", values[:n], values[:n])
        mean[:, square] = norms.reshape(count, size).mean(axis=1)
        if square == 7:
            mean[:, 6] = np.sqrt(norms).reshape(count, size).mean(axis=1)
    end = imu.t[size - 1 : n : size]
    start = np.r_[imu.t[0] - row_period, end[:-1]]
    whole = end - start < size * row_period + max(_LONGEST_BLOCK_GAP, row_period)
    return BlockMeans(end - 0.5 * size * row_period, end, mean, size * row_period, row_period, whole)


def compute_window_times(t: Array, length: int, step: int = 1) -> Array:
    """Centres of the windows of `Sums.means`."""
    first = t[: len(t) - length + 1 : step]
    return np.asarray(0.5 * (first + t[length - 1 :: step]))


def find_unbroken(whole: Array, length: int, step: int = 1, first: int = 1) -> Array:
    """Which of these windows no gap crosses; `whole` as in `BlockMeans`.

    A gap before the first row of a window is harmless, except with `first` 0, where rows are means that may contain it.
    """
    broken = np.r_[0, np.cumsum(~whole)]
    begin = np.arange(0, len(whole) - length + 1, step)
    return np.asarray(broken[begin + length] - broken[begin + first] == 0)


@dataclass(frozen=True)
class WindowMeans:
    """Means over the windows of a recording."""

    t: Array  # (W,) s, centre
    half: float  # s, of a window
    rows: Array  # (W, 9) [force, rate, |force|, |force|^2, |rate|^2]
    whole: Array  # (W,) bool, False where a window crosses a gap


def compute_window_means(b: BlockMeans, length: float) -> WindowMeans | None:
    """Means over windows of `length` s every tenth of a second; None where there is no window."""
    # the blocks between two windows are summed once for all windows
    group = max(1, min(round(WINDOW_STEP / b.period), round(0.5 * length / b.period)))
    count = len(b.t) // group
    rows = b.mean[: count * group].reshape(count, group, -1).mean(axis=1)
    middle = b.t[: count * group].reshape(count, group).mean(axis=1)
    whole = np.asarray(b.whole[: count * group].reshape(count, group).all(axis=1))
    window = max(2, round(length / (group * b.period)))
    if count < window:
        return None
    return WindowMeans(
        compute_window_times(middle, window),
        0.5 * length,
        sum_rows(rows).compute_means(window),
        find_unbroken(whole, window, first=0),
    )


@dataclass(frozen=True)
class LowPassed:
    """The IMU below about 2 Hz: the motion of the body, without the engine's vibration from 8 Hz on."""

    t: Array  # (K,) s, centre of the kernel
    rows: Array  # (K, 6) force, rate
    gain: float  # 1/sqrt(s): noise density -> 1-sigma of a row
    period: float  # s
    whole: Array  # (K,) bool, False where there is a gap under the kernel


def make_kernel(period: float) -> Array:
    """A Blackman window of `_KERNEL_LENGTH` s, sum 1: -6 dB at 3 Hz, below -58 dB from 7.5 Hz on."""
    n = max(2, round(_KERNEL_LENGTH / period))
    h = np.blackman(n + 2)[1:-1]
    return np.asarray(h / h.sum())


def low_pass(b: BlockMeans) -> LowPassed:
    """Low-pass the blocks and keep every tenth of a second."""
    h = make_kernel(b.period)
    step = max(1, int(1.0 / (_LOW_RATE * b.period) + 1e-6))
    count = max(0, (len(b.t) - len(h)) // step + 1)
    rows = np.zeros((count, 6))
    stop = step * (count - 1) + 1
    for i, weight in enumerate(h if count else ()):
        rows += weight * b.mean[i : i + stop : step, :6]
    gain = float(np.sqrt((h**2).sum() / b.period))
    t = compute_window_times(b.t, len(h), step)[:count] if count else np.zeros(0)
    whole = find_unbroken(b.whole, len(h), step)[:count] if count else np.zeros(0, dtype=bool)
    return LowPassed(t, rows, gain, step * b.period, whole)


def compute_share(x: Array, share: float) -> Array:
    """`np.quantile` along the first axis, several times faster for a few hundred rows."""
    x = np.sort(x, axis=0)
    at = share * (len(x) - 1)
    k = int(at)
    return np.asarray(x[k] + (at - k) * (x[min(k + 1, len(x) - 1)] - x[k]))


def low_pass_rows(rows: Array, h: Array) -> Array:
    """All rows filtered with h, (K - len(h) + 1, c): for a short span."""
    return np.asarray(sliding_window_view(rows, len(h), axis=0) @ h)
