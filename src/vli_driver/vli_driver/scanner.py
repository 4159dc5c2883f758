"""A short frame to a triangulated stripe."""

from __future__ import annotations

from vli_common.calibration import Calibration
from vli_common.errors import InputError
from vli_common.types import Counters, Image, LaserScan
from vli_driver.config import StripeConfig
from vli_driver.stripe import CentreOfMassDetector, StripeDetector
from vli_driver.stripe_hint import StripeHint
from vli_driver.triangulation import Triangulator, search_band, stripe_runs_across_columns


class StripeScanner:
    """Detector and triangulation, eq. (1).

    Args:
        calibration: camera and laser plane.
        config: see :class:`StripeConfig`.
        detector: in place of the default one.

    Raises:
        CalibrationError: there is no laser plane, or it cannot be seen within its range.
    """

    def __init__(
        self, calibration: Calibration, config: StripeConfig | None = None, detector: StripeDetector | None = None
    ) -> None:
        config = config or StripeConfig()
        self.counters = Counters()
        self._camera = calibration.camera
        along_columns = self._along_columns(calibration, config)
        band = search_band(calibration, along_columns, config.range_margin)
        self._detector: StripeDetector = detector or CentreOfMassDetector(config, band)
        self._triangulator = Triangulator(calibration, along_columns, config.range_margin)
        self._min_points = config.min_points
        self._hint = StripeHint(calibration, config, along_columns)

    def scan(self, short: Image) -> LaserScan:
        """Return the stripe of a short frame in the camera frame; empty where none is seen.

        Raises:
            InputError: the image is not of the calibrated size.
        """
        self._check_size(short)
        scan = self._scan(short)
        self._hint.add(short.pixels, scan)
        return scan

    @property
    def hint(self) -> str:
        """What is wrong with the stripe, and what to do, in words; empty where nothing is."""
        return self._hint.text

    def _scan(self, short: Image) -> LaserScan:
        stripe = self._detector.detect(short.pixels)
        points, sigma, valid = self._triangulator.triangulate(stripe.pixels, stripe.sigma_px)
        self.counters.add("out_of_range", int(len(valid) - valid.sum()))
        if valid.sum() < self._min_points:
            self.counters.add("empty")
            return LaserScan.empty(short.stamp_ns, short.session)
        self.counters.add("scans")
        return LaserScan(
            short.stamp_ns, points[valid], stripe.pixels[valid], stripe.intensity[valid], sigma[valid], short.session
        )

    def _check_size(self, image: Image) -> None:
        height, width = image.pixels.shape[:2]
        if (width, height) != (self._camera.width, self._camera.height):
            raise InputError(
                f"image is '{width} x {height}', the calibration is for {self._camera.width} x {self._camera.height}; "
                "use the calibration of this camera and resolution"
            )

    @staticmethod
    def _along_columns(calibration: Calibration, config: StripeConfig) -> bool:
        if config.orientation == "auto":
            return calibration.laser is None or stripe_runs_across_columns(calibration.laser)
        return config.orientation == "columns"
