"""What a camera, an IMU and a laser must offer so that the scanner runs on them: the bag does, hardware can."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from vli_common.types import EncodedImage, ImuSample


@runtime_checkable
class ImageSource(Protocol):
    """Yields the interleaved stream of long and short exposures, stamps at mid-exposure."""

    def images(self) -> Iterator[EncodedImage]:
        """Yield images as they come, until the source ends or is closed."""
        ...

    def close(self) -> None:
        """Stop and release the device; iterating ends."""
        ...


@runtime_checkable
class ImuSource(Protocol):
    """Yields samples in the IMU's own frame, ``imu_link``, in rad/s and m/s²."""

    def samples(self) -> Iterator[ImuSample]:
        """Yield samples in the order of their stamps, until the source ends or is closed."""
        ...

    def close(self) -> None:
        """Stop and release the device; iterating ends."""
        ...


@runtime_checkable
class TriggeredCamera(Protocol):
    """A camera that exposes when told to, for as long as told."""

    def trigger(self, exposure_s: float) -> None:
        """Begin one exposure now; it ends by itself after ``exposure_s``. The image comes later, see ``Sequencer.on_image``."""
        ...


@runtime_checkable
class LaserSwitch(Protocol):
    """Turns the laser on and off; takes effect before the next exposure begins."""

    def set_laser(self, on: bool) -> None:
        """Switch the laser."""
        ...
