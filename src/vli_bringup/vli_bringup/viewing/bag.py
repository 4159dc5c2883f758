"""A bag image by image, with the stripe found in each, and what the IMU measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from vli_bringup.settings import Settings
from vli_bringup.stamps import seconds_text
from vli_bringup.viewing.scene import Scene
from vli_common.arrays import ByteArray, FloatArray
from vli_common.calibration import Calibration
from vli_common.errors import InputError
from vli_common.types import NANOSECONDS, EncodedImage, Exposure, ImuSample, LaserScan
from vli_driver.decode import decode
from vli_driver.demux import Demultiplexer
from vli_driver.scanner import StripeScanner

STRIPE = "/stripe"
_CAMERA = "/camera"
_STRIPE_RGB = (40, 220, 60)
_POINT_M = 2e-4
_CAMERA_M = 0.01
_EYE, _TARGET = np.array([0.05, -0.04, -0.02]), np.array([0.0, 0.0, 0.025])
"""In the camera's frame: from behind it, towards what it scans."""
_CACHED = 64
_ROUND = 16
"""Sub-pixel steps of the dots that are drawn, as a power of two: 4 bits."""


@dataclass
class Recording:
    """A stretch of a bag in memory, images as they were stored.

    Args:
        images: in the order of the bag.
        exposures: what the demultiplexer said of each that it could tell, by stamp.
        imu: samples, in the order of the bag.
    """

    images: list[EncodedImage] = field(default_factory=list)
    exposures: dict[int, Exposure] = field(default_factory=dict)
    imu: list[ImuSample] = field(default_factory=list)


def read_recording(items: Iterable[EncodedImage | ImuSample], settings: Settings) -> Recording:
    """Take everything, and sort the images as a run would; those that cannot be decoded are left out.

    Raises:
        InputError: there is no image.
    """
    recording, demultiplexer = Recording(), Demultiplexer(settings.demux)
    for item in items:
        if isinstance(item, ImuSample):
            recording.imu.append(item)
            continue
        try:
            sorted_out = demultiplexer.push(decode(item))
        except InputError:
            continue
        recording.images.append(item)
        recording.exposures.update((image.stamp_ns, exposure) for exposure, image in sorted_out)
    recording.exposures.update((image.stamp_ns, exposure) for exposure, image in demultiplexer.flush())
    if not recording.images:
        raise InputError("there is no image to show in this part of the bag; choose another with --start and --duration")
    return recording


class BagDisplay:
    """Shows one image of a recording at a time.

    Args:
        scene: to show it in.
        recording: with at least one image.
        scanner: finds and triangulates the stripe; None where there is no calibration of a laser.
        calibration: of the camera, for its field of view.
    """

    def __init__(
        self, scene: Scene, recording: Recording, scanner: StripeScanner | None, calibration: Calibration | None
    ) -> None:
        self._scene, self._recording, self._scanner = scene, recording, scanner
        self._pixels = lru_cache(_CACHED)(self._decoded)
        scene.server.scene.set_up_direction("-y")
        scene.view_from(_EYE, _TARGET)
        with scene.gui.add_folder("Images"):
            self.index = scene.gui.add_slider("image", 0, max(len(recording.images) - 1, 1), 1, 0)
            self.kind = scene.gui.add_dropdown("step through", ("all", *(item.name.lower() for item in Exposure)))
            back, on = scene.gui.add_button("◀ before"), scene.gui.add_button("next ▶")
            self.text = scene.gui.add_markdown("")
            self._image = scene.gui.add_image(self._pixels(0), format="jpeg")
        if calibration is not None:
            self._add_camera(calibration)
        if recording.imu:
            self._add_imu()
        self.index.on_update(lambda _: self.show(int(self.index.value)))
        back.on_click(lambda _: self.step(-1))
        on.on_click(lambda _: self.step(1))
        self.show(0)

    def step(self, direction: int) -> None:
        """Go to the next image of the chosen kind, forwards (1) or backwards (-1); stay where there is none."""
        index = int(self.index.value) + direction
        while 0 <= index < len(self._recording.images):
            exposure = self._exposure(index)
            if self.kind.value == "all" or (exposure is not None and exposure.name.lower() == self.kind.value):
                self.index.value = index
                return
            index += direction

    def show(self, index: int) -> None:
        """Show one image and, in a short one, the stripe."""
        index = min(index, len(self._recording.images) - 1)
        pixels, scan = self._pixels(index), self._scan(index)
        self._image.image = pixels if scan is None else _with_stripe(pixels, scan)
        self.text.content = self._caption(index, scan)
        points = np.empty((0, 3), np.float32) if scan is None else scan.points.astype(np.float32)
        self._scene.cloud(STRIPE, points, _STRIPE_RGB, _POINT_M)

    def _exposure(self, index: int) -> Exposure | None:
        return self._recording.exposures.get(self._recording.images[index].stamp_ns)

    def _decoded(self, index: int) -> ByteArray:
        """Return an image as RGB (H, W, 3)."""
        pixels = decode(self._recording.images[index]).pixels
        code = cv2.COLOR_GRAY2RGB if pixels.ndim == 2 else cv2.COLOR_BGR2RGB
        rgb: ByteArray = np.asarray(cv2.cvtColor(pixels, code), np.uint8)
        return rgb

    def _scan(self, index: int) -> LaserScan | None:
        if self._scanner is None or self._exposure(index) is not Exposure.SHORT:
            return None
        return self._scanner.scan(decode(self._recording.images[index]))

    def _caption(self, index: int, scan: LaserScan | None) -> str:
        image, exposure = self._recording.images[index], self._exposure(index)
        since_s = (image.stamp_ns - self._recording.images[0].stamp_ns) / NANOSECONDS
        kind = "neither long nor short" if exposure is None else f"{exposure.name.lower()} exposure"
        lines = [f"{since_s:.3f} s, stamp {seconds_text(image.stamp_ns)}: **{kind}**"]
        if scan is not None and len(scan):
            depth_mm = 1e3 * scan.points[:, 2]
            lines.append(f"{len(scan)} stripe points, depth {depth_mm.min():.1f} to {depth_mm.max():.1f} mm")
        elif scan is not None:
            lines.append("no stripe within the laser's range")
        elif self._scanner is None:
            lines.append("the stripe is found where a calibration with laser0 is given: --calib C")
        return "\n\n".join(lines)

    def _add_camera(self, calibration: Calibration) -> None:
        camera = calibration.camera
        fov = 2 * np.arctan(0.5 * camera.height / camera.matrix[1, 1])
        self._scene.server.scene.add_camera_frustum(
            _CAMERA, float(fov), camera.width / camera.height, scale=_CAMERA_M, thickness=2.0, thickness_units="screen"
        )

    def _add_imu(self) -> None:
        samples = self._recording.imu
        first_ns = self._recording.images[0].stamp_ns
        time_s = np.array([(item.stamp_ns - first_ns) / NANOSECONDS for item in samples])
        for title, values in (
            ("angular velocity, rad/s", np.array([item.gyro for item in samples])),
            ("specific force, m/s²", np.array([item.accel for item in samples])),
        ):
            _add_traces(self._scene.gui, title, time_s, values)


def _add_traces(gui: Any, title: str, time_s: FloatArray, values: FloatArray) -> None:
    """Add x, y and z (N, 3) over time (N,)."""
    colours = zip("xyz", ("#d62728", "#2ca02c", "#1f77b4"), strict=True)
    series = ({"label": "s"}, *({"label": axis, "stroke": colour, "width": 1} for axis, colour in colours))
    columns = tuple(np.ascontiguousarray(column) for column in (time_s, *values.T))
    gui.add_uplot(columns, series, title=title, scales={"x": {"time": False}}, aspect=2.0)


def _with_stripe(pixels: ByteArray, scan: LaserScan) -> ByteArray:
    """Return a copy of an RGB image with a dot on every stripe point."""
    marked = pixels.copy()
    for u, v in np.rint(scan.pixels * _ROUND).astype(int).tolist():
        cv2.circle(marked, (u, v), _ROUND, _STRIPE_RGB, cv2.FILLED, cv2.LINE_AA, shift=4)
    return marked
