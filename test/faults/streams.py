"""Recordings with something wrong: edits of a stream of images and IMU samples in log order, nothing encoded anew.

Time is counted in seconds since the first image. In the recordings of these tests long and short frames take turns and the
first is long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from vli_common.arrays import BoolArray, ByteArray, FloatArray
from vli_common.types import NANOSECONDS, EncodedImage, ImuSample
from vli_driver.decode import decode

Item = EncodedImage | ImuSample
Stream = list[Item]
PERIOD_NS = NANOSECONDS // 60


@dataclass(frozen=True)
class Span:
    """Seconds [begin, end) since the first image."""

    begin_s: float
    end_s: float = 1e9

    def mask(self, stream: Stream) -> BoolArray:
        """Return which items (N,) of a stream were taken in it."""
        first_ns = images(stream)[0].stamp_ns
        times = (np.array([item.stamp_ns for item in stream]) - first_ns) / NANOSECONDS
        return (times >= self.begin_s - 1e-6) & (times < self.end_s - 1e-6)


ALWAYS = Span(-1e9)


def images(stream: Stream) -> list[EncodedImage]:
    return [item for item in stream if isinstance(item, EncodedImage)]


def samples(stream: Stream) -> list[ImuSample]:
    return [item for item in stream if isinstance(item, ImuSample)]


def is_image(stream: Stream) -> BoolArray:
    return np.array([isinstance(item, EncodedImage) for item in stream])


def is_long(stream: Stream) -> BoolArray:
    """Return which items (N,) are long frames."""
    first_ns = images(stream)[0].stamp_ns
    slots = np.array([round((item.stamp_ns - first_ns) / PERIOD_NS) for item in stream])
    return is_image(stream) & (slots % 2 == 0)


def is_short(stream: Stream) -> BoolArray:
    return is_image(stream) & ~is_long(stream)


def is_imu(stream: Stream) -> BoolArray:
    return ~is_image(stream)


def until(stream: Stream, seconds: float) -> Stream:
    return drop(stream, Span(seconds).mask(stream))


def drop(stream: Stream, which: BoolArray) -> Stream:
    return [item for item, out in zip(stream, which, strict=True) if not out]


def change(stream: Stream, which: BoolArray, edit: Callable[[Item], Item]) -> Stream:
    return [edit(item) if chosen else item for item, chosen in zip(stream, which, strict=True)]


def duplicate(stream: Stream, which: BoolArray) -> Stream:
    return [copy for item, chosen in zip(stream, which, strict=True) for copy in [item] * (1 + int(chosen))]


def swap_with_next(stream: Stream, which: BoolArray) -> Stream:
    """Let each chosen item change places with the next one of its kind, as a transport that does not keep order does."""
    result = list(stream)
    for index in np.flatnonzero(which):
        following = (k for k in range(index + 1, len(stream)) if isinstance(stream[k], type(stream[index])))
        other = next(following, index)
        result[index], result[other] = result[other], result[index]
    return result


def shift(item: Item, by_ns: int) -> Item:
    return replace(item, stamp_ns=item.stamp_ns + by_ns)


def repaint(image: Item, paint: Callable[[ByteArray], ByteArray]) -> EncodedImage:
    """Return an image with other pixels, (H, W, 3) BGR, not compressed."""
    assert isinstance(image, EncodedImage)
    pixels = np.ascontiguousarray(paint(decode(image).pixels.copy()))
    height, width = pixels.shape[:2]
    return EncodedImage(image.stamp_ns, pixels.tobytes(), "bgr8", width, height, 3 * width)


def paint(stream: Stream, which: BoolArray, brush: Callable[[ByteArray], ByteArray]) -> Stream:
    return change(stream, which, lambda item: repaint(item, brush))


def feel(stream: Stream, which: BoolArray, gyro: FloatArray | float = 0.0, accel: FloatArray | float = 0.0) -> Stream:
    """Add to what the IMU measures."""
    return change(stream, which, lambda item: replace(item, gyro=item.gyro + gyro, accel=item.accel + accel))


def backwards(stream: Stream, rest: Span) -> Stream:
    """Return the recording in reverse: what a scanner sees and feels that goes the same way back.

    Forces stay what they were, turns change their sign; the gyroscope's bias does not, and is taken from a rest.
    """
    end_ns, first_ns = stream[-1].stamp_ns, stream[0].stamp_ns
    still = [item for item, at_rest in zip(stream, rest.mask(stream), strict=True) if at_rest and isinstance(item, ImuSample)]
    bias = np.mean([sample.gyro for sample in still], axis=0)

    def turned(item: Item) -> Item:
        stamp_ns = first_ns + end_ns - item.stamp_ns
        if isinstance(item, ImuSample):
            return replace(item, stamp_ns=stamp_ns, gyro=2 * bias - item.gyro)
        return replace(item, stamp_ns=stamp_ns)

    return [turned(item) for item in reversed(stream)]


def there_and_back(stream: Stream, rest: Span) -> Stream:
    """Return a scan that comes the way back first, rests where the recording does, and then goes the way again.

    The frame in the middle is shown once; around it time is mirrored.
    """
    first_ns = images(stream)[0].stamp_ns
    # From the last long frame on, so that the first is long, as everywhere here.
    last_ns = max(item.stamp_ns for item, long in zip(stream, is_long(stream), strict=True) if long)
    margin_ns = NANOSECONDS // 20
    whole = [
        item
        for item in stream
        if (first_ns if isinstance(item, EncodedImage) else first_ns - margin_ns) <= item.stamp_ns
        and item.stamp_ns <= (last_ns if isinstance(item, EncodedImage) else last_ns + margin_ns)
    ]
    back = [item for item in backwards(whole, rest) if item.stamp_ns <= whole[0].stamp_ns + (whole[-1].stamp_ns - first_ns)]
    offset_ns = back[-1].stamp_ns - first_ns
    return back + [shift(item, offset_ns) for item in whole if item.stamp_ns > first_ns]


def at_rest(stream: Stream, rest: Span, seconds: float, seed: int) -> Stream:
    """Return a rest of any length, made of the one in the recording: its frames again and again, and fresh noise of the IMU."""
    still = [item for item, chosen in zip(stream, rest.mask(stream), strict=True) if chosen]
    frames = images(still)
    frames = frames[: len(frames) // 2 * 2]
    imu = samples(still)
    gyro, accel = (np.array([getattr(sample, name) for sample in imu]) for name in ("gyro", "accel"))
    rng = np.random.default_rng(seed)
    begin_ns = frames[0].stamp_ns
    step_ns = round(np.median(np.diff([sample.stamp_ns for sample in imu])))
    count, ticks = round(seconds * NANOSECONDS / PERIOD_NS) // 2 * 2, round(seconds * NANOSECONDS / step_ns)
    which = rng.integers(0, len(frames) // 2, count)
    shown = [replace(frames[2 * which[k] + k % 2], stamp_ns=begin_ns + k * PERIOD_NS) for k in range(count)]
    felt = [
        ImuSample(begin_ns + k * step_ns, rng.normal(gyro.mean(0), gyro.std(0)), rng.normal(accel.mean(0), accel.std(0)))
        for k in range(ticks)
    ]
    return in_order([*shown, *felt])


def after(first: Stream, second: Stream) -> Stream:
    """Return one recording and then another, whose stamps go on where the first one's end."""
    by_ns = first[-1].stamp_ns + PERIOD_NS - second[0].stamp_ns
    return [*first, *(shift(item, by_ns) for item in second)]


def in_order(items: Iterable[Item]) -> Stream:
    return sorted(items, key=lambda item: item.stamp_ns)
