"""The images: do long and short alternate, are they exposed well, is there something to track, is there a stripe?"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from vli_bringup.diagnosis.findings import Finding, Level
from vli_bringup.diagnosis.stamps import check_stamps
from vli_bringup.settings import Settings
from vli_common.arrays import ByteArray
from vli_common.calibration import Calibration
from vli_common.errors import InputError
from vli_common.types import EncodedImage, Exposure, Image, ImuSample, LaserScan
from vli_driver.brightness import brightness
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner

_EVERY = 10
"""Long frames from one that is looked at closely to the next."""
_DARK, _BRIGHT_SHARE = 15.0, 0.05
_SATURATED = 250
_FEW_CORNERS, _ENOUGH_CORNERS = 20, 50
_CORNER_QUALITY, _CORNER_DISTANCE_PX = 0.01, 15
_STRIPE_SHARE = 0.8
_AT_THE_EDGE = 0.02
"""Share of the working range that counts as its end."""


class CameraCheck:
    """Images as they come, sorted and scanned as a run would.

    Args:
        calibration: None leaves sizes, rates and the stripe out.
        settings: of demultiplexer and stripe detector.
    """

    def __init__(self, calibration: Calibration | None, settings: Settings) -> None:
        self._calibration = calibration
        self._demultiplexer = Demultiplexer(settings.demux)
        laser = calibration is not None and calibration.laser is not None
        self._scanner = StripeScanner(calibration, settings.stripe) if calibration is not None and laser else None
        self._stamps: list[int] = []
        self._undecodable: list[str] = []
        self._size: tuple[int, int] | None = None
        self._levels: dict[Exposure, list[float]] = {Exposure.LONG: [], Exposure.SHORT: []}
        self._saturated: list[float] = []
        self._corners: list[int] = []
        self._scans: list[LaserScan] = []

    def add(self, item: EncodedImage | ImuSample) -> None:
        """Take an image; the IMU is none of this check's business."""
        if isinstance(item, ImuSample):
            return
        self._stamps.append(item.stamp_ns)
        try:
            image = decode(item)
        except InputError as error:
            self._undecodable.append(str(error))
            return
        self._size = (image.pixels.shape[1], image.pixels.shape[0])
        for exposure, sorted_image in self._demultiplexer.push(image):
            self._look(exposure, sorted_image)

    def findings(self) -> Iterator[Finding]:
        """Say what was found."""
        for exposure, image in self._demultiplexer.flush():
            self._look(exposure, image)
        calibration = self._calibration
        yield from check_stamps("camera", self._stamps, calibration.rate_hz if calibration else None, "cam0.rate_hz")
        if self._undecodable:
            text = f"{len(self._undecodable)} of {len(self._stamps)} images cannot be decoded: {self._undecodable[0]}"
            yield Finding(Level.PROBLEM if len(self._undecodable) == len(self._stamps) else Level.WARNING, "camera", text)
        yield from self._check_size()
        if self._levels[Exposure.LONG]:
            yield from self._check_alternation()
            yield from self._check_long()
        yield from self._check_stripe()

    def _look(self, exposure: Exposure, image: Image) -> None:
        levels = self._levels[exposure]
        if exposure is Exposure.LONG and len(levels) % _EVERY == 0:
            self._saturated.append(float((image.pixels >= _SATURATED).mean()))
            self._corners.append(_count_corners(image.pixels))
        levels.append(brightness(image.pixels))
        if exposure is Exposure.SHORT and self._scanner is not None and self._fits:
            self._scans.append(self._scanner.scan(image))

    @property
    def _fits(self) -> bool:
        return self._calibration is None or self._size == (self._calibration.camera.width, self._calibration.camera.height)

    def _check_size(self) -> Iterator[Finding]:
        if not self._fits and self._size is not None and self._calibration is not None:
            camera = self._calibration.camera
            text = f"images are {self._size[0]} x {self._size[1]}, the calibration is for {camera.width} x {camera.height}"
            yield Finding(Level.PROBLEM, "camera", f"{text}; calibrate the camera at this resolution")

    def _check_alternation(self) -> Iterator[Finding]:
        long, short = (self._levels[exposure] for exposure in (Exposure.LONG, Exposure.SHORT))
        if not short:
            text = "long and short exposures do not alternate: all are taken as long, and only --mode vi works; check the trigger"
            yield Finding(Level.PROBLEM, "exposures", text)
            return
        ratio = float(np.median(long)) / max(float(np.median(short)), 1.0)
        yield Finding(Level.GOOD, "exposures", f"{len(long)} long and {len(short)} short, {ratio:.1f} times as bright")
        counters = self._demultiplexer.counters
        odd = {name: counters[name] for name in ("phase_swap", "dark_long", "ambient_light", "unclear") if counters[name]}
        if sum(odd.values()) > 0.01 * len(self._stamps):
            listed = ", ".join(f"{count} × {name.replace('_', ' ')}" for name, count in odd.items())
            text = f"some frames are not what their turn says ({listed}); ambient light, or triggers lost"
            yield Finding(Level.WARNING, "exposures", text)

    def _check_long(self) -> Iterator[Finding]:
        level, saturated = float(np.median(self._levels[Exposure.LONG])), float(np.median(self._saturated))
        if level < _DARK:
            text = f"long exposures are dark (grey level {level:.0f} of 255); expose longer or add light"
            yield Finding(Level.WARNING, "long frames", text)
        elif saturated > _BRIGHT_SHARE:
            text = f"{100 * saturated:.0f} % of the pixels of long exposures are saturated; expose shorter"
            yield Finding(Level.WARNING, "long frames", text)
        else:
            yield Finding(Level.GOOD, "long frames", f"grey level {level:.0f} of 255, {100 * saturated:.1f} % saturated")
        corners = int(np.median(self._corners))
        if corners >= _ENOUGH_CORNERS:
            yield Finding(Level.GOOD, "texture", f"{corners} corners to track")
            return
        few = corners < _FEW_CORNERS
        text = f"{corners} corners to track, {_ENOUGH_CORNERS} are wanted; more texture (dots, spray), more light, or focus"
        yield Finding(Level.PROBLEM if few else Level.WARNING, "texture", text)

    def _check_stripe(self) -> Iterator[Finding]:
        laser = self._calibration.laser if self._calibration else None
        if not self._scans or laser is None:
            return
        seen = [scan for scan in self._scans if len(scan)]
        share = len(seen) / len(self._scans)
        if not seen:
            text = f"no stripe in {len(self._scans)} short frames; laser on? within {_range_text(laser.range_m)}?"
            yield Finding(Level.PROBLEM, "stripe", f"{text} If it is seen in the images: 'vli calibrate check'")
            return
        depth = np.concatenate([scan.points[:, 2] for scan in seen])
        low, middle, high = np.percentile(depth, [5, 50, 95])
        text = f"in {100 * share:.0f} % of the short frames, {np.median([len(scan) for scan in seen]):.0f} points each, at "
        text += f"{1e3 * low:.0f} to {1e3 * high:.0f} mm"
        yield Finding(Level.GOOD if share >= _STRIPE_SHARE else Level.WARNING, "stripe", text)
        margin = _AT_THE_EDGE * (laser.range_m[1] - laser.range_m[0])
        if not laser.range_m[0] + margin <= middle <= laser.range_m[1] - margin:
            text = f"half of the points lie at the end of the working range {_range_text(laser.range_m)}; change the distance"
            yield Finding(Level.WARNING, "stripe", text)


def _count_corners(pixels: ByteArray) -> int:
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    corners = cv2.goodFeaturesToTrack(grey, 200, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
    return 0 if corners is None else len(corners)


def _range_text(range_m: tuple[float, float]) -> str:
    return f"{1e3 * range_m[0]:.0f} to {1e3 * range_m[1]:.0f} mm"
