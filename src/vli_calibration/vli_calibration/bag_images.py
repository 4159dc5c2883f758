"""The telling moments of a bag: spread over its length, the camera at rest where it ever is, else as slow as it gets.

A bag is cut into as many spans of equal length as moments are wanted; each span gives its best frame. How far the picture moves
between two frames is measured without features: the RMS of the difference over the RMS of the gradient is the RMS of the
motion along the gradient, in pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from vli_calibration.progress import progress
from vli_calibration.types import CalibrationImage
from vli_common.arrays import ByteArray, Float32Array
from vli_common.errors import InputError
from vli_common.types import NANOSECONDS, EncodedImage, Exposure, Image
from vli_driver.bag import DEFAULT_IMAGE_TOPIC, BagReader, BagTopics
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer

DEFAULT_MOMENTS = 60
_THUMB_PX = 320
_STILL_PX = 0.15
"""Motion of the reduced picture below which the camera counts as being at rest: little above the noise."""
_SAME_VIEW_PX = 1.0
_PAIR_S = 0.1
"""A short frame farther from its long one in time shows something else."""


@dataclass(frozen=True, slots=True)
class _Moment:
    """A long frame, the short one nearest in time, its reduced picture, and what it is worth."""

    long: Image
    thumb: Float32Array
    short: Image | None = None
    motion_px: float = 0.0
    sharpness: float = 0.0

    def rank(self) -> tuple[bool, float]:
        """Return what sorts the better moment first: one at rest by its sharpness, another by its motion."""
        still = self.motion_px < _STILL_PX
        return not still, -self.sharpness if still else self.motion_px


def is_bag(path: Path) -> bool:
    """Return True for an ``.mcap`` or ``.db3`` file, and for a directory that holds one."""
    if path.is_dir():
        return any(item.suffix in (".mcap", ".db3") or item.name == "metadata.yaml" for item in path.iterdir())
    return path.suffix in (".mcap", ".db3")


def read_bag_images(path: Path, image_topic: str = DEFAULT_IMAGE_TOPIC, moments: int = DEFAULT_MOMENTS) -> list[CalibrationImage]:
    """Return at most ``moments`` images of a bag, each with the short exposure beside it where exposures alternate.

    Names are seconds since the first image. Of a camera that rests, views that repeat the one before are left out.

    Raises:
        InputError: no images.
    """
    reader = BagReader(path, BagTopics(image=image_topic, imu_required=False))
    start_ns, end_ns = reader.time_range_ns
    span_ns = max(1, (end_ns - start_ns) // moments + 1)
    best: dict[int, _Moment] = {}
    first_ns: int | None = None
    for moment in _moments(sorted_frames(reader, "reading the bag")):
        first_ns = moment.long.stamp_ns if first_ns is None else first_ns
        span = (moment.long.stamp_ns - first_ns) // span_ns
        if span not in best or moment.rank() < best[span].rank():
            best[span] = moment
    if first_ns is None:
        raise InputError(f"topic '{reader.image_topic}' in '{path}' holds no image to calibrate from; record again")
    return [_as_image(moment, first_ns) for moment in _without_repeats([best[span] for span in sorted(best)])]


def sorted_frames(reader: BagReader, text: str) -> Iterator[tuple[Exposure, Image]]:
    """Yield the decoded images of a bag as long or short exposures, in order.

    Frames that cannot be decoded, or have another shape than the first, are passed over.

    Args:
        reader: of a bag whose images are wanted.
        text: for the progress bar.

    Raises:
        InputError: not one frame can be decoded.
    """
    demultiplexer = Demultiplexer()
    shape: tuple[int, ...] | None = None
    problem: InputError | None = None
    encoded = (item for item in reader if isinstance(item, EncodedImage))
    for item in progress(encoded, reader.count(reader.image_topic), text):
        try:
            image = decode(item)
        except InputError as error:
            problem = problem or error
            continue
        shape = shape or image.pixels.shape
        if image.pixels.shape == shape:
            yield from demultiplexer.push(image)
    if shape is None and problem is not None:
        raise problem
    yield from demultiplexer.flush()


def _moments(frames: Iterator[tuple[Exposure, Image]]) -> Iterator[_Moment]:
    """Yield each long frame once its neighbours on either side are known."""
    pending: _Moment | None = None
    short: Image | None = None
    for exposure, image in frames:
        if exposure is Exposure.SHORT:
            short = image
            pending = pending and _nearer(pending, image)
            continue
        thumb = _thumb(image.pixels)
        moment = _nearer(_Moment(image, thumb, sharpness=float(cv2.Laplacian(thumb, cv2.CV_32F).std())), short)
        if pending is not None:
            between_px = motion_px(pending.thumb, thumb)
            yield replace(pending, motion_px=max(pending.motion_px, between_px))
            moment = replace(moment, motion_px=between_px)
        pending = moment
    if pending is not None:
        yield pending


def _nearer(moment: _Moment, short: Image | None) -> _Moment:
    """Return the moment with the short frame that is nearest in time, of its own and another."""
    if short is None:
        return moment
    there = moment.short
    away_ns = abs(short.stamp_ns - moment.long.stamp_ns)
    if away_ns > _PAIR_S * NANOSECONDS or (there is not None and abs(there.stamp_ns - moment.long.stamp_ns) <= away_ns):
        return moment
    return replace(moment, short=short)


def _thumb(pixels: ByteArray) -> Float32Array:
    """Return a grey picture (h, w) float32, at most 320 px wide, blurred a little so that its gradient is smooth."""
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _THUMB_PX / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cast(Float32Array, cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float32))


def motion_px(before: Float32Array, after: Float32Array) -> float:
    """Return how far a picture (h, w) has moved to become another, RMS along its gradient, in pixels."""
    gradient = cv2.Sobel(before, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(before, cv2.CV_32F, 0, 1, scale=0.125)
    energy = float(np.mean(gradient[0] ** 2 + gradient[1] ** 2))
    change = float(np.mean((after - before - np.mean(after - before)) ** 2))
    # Along a gradient of random direction half of the squared motion shows.
    return float(np.sqrt(2 * change / max(energy, 1e-6)))


def _without_repeats(moments: list[_Moment]) -> list[_Moment]:
    kept: list[_Moment] = []
    for moment in moments:
        if not kept or motion_px(kept[-1].thumb, moment.thumb) > _SAME_VIEW_PX:
            kept.append(moment)
    return kept


def _as_image(moment: _Moment, first_ns: int) -> CalibrationImage:
    name = f"{(moment.long.stamp_ns - first_ns) / NANOSECONDS:.3f} s"
    return CalibrationImage(name, moment.long.pixels, None if moment.short is None else moment.short.pixels)
