"""Images to calibrate from: a directory of files, or the telling moments of a bag."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from vli_calibration.bag_images import DEFAULT_MOMENTS, is_bag, read_bag_images
from vli_calibration.poses import read_poses
from vli_calibration.progress import progress
from vli_calibration.types import CalibrationImage
from vli_common.arrays import AnyArray, ByteArray, FloatArray
from vli_common.errors import InputError
from vli_common.types import EncodedImage
from vli_driver.bag import DEFAULT_IMAGE_TOPIC
from vli_driver.decode import decode

__all__ = ["read_images", "read_poses"]

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"})
_PAIRS = (("_long", "_short"), ("_off", "_on"), ("", "_laser"))
"""Ends of the stems of one scene's two exposures: the one that shows the board, the one that shows the stripe."""

_LONG, _SHORT = "long", "short"
_PNG_START, _PNG_END = b"\x89PNG", b"IEND\xaeB`\x82"
_JPEG_START = b"\xff\xd8"
_NAMED_AT_MOST = 5


@dataclass(frozen=True, slots=True)
class _Source:
    """The files of one scene: that of the board and, where exposures come in pairs, that of the stripe."""

    name: str
    board: Path
    stripe: Path | None = None

    def files(self) -> list[Path]:
        """Return the file, or both of a pair."""
        return [self.board] if self.stripe is None else [self.board, self.stripe]


def read_images(
    path: Path, poses: Path | None = None, image_topic: str = DEFAULT_IMAGE_TOPIC, moments: int = DEFAULT_MOMENTS
) -> list[CalibrationImage]:
    """Return the images of a directory in natural order (im2 before im10), or those of a bag in order of time.

    In a directory, ``X_long`` + ``X_short``, ``X_off`` + ``X_on``, ``X`` + ``X_laser``, and equal names in the folders ``long``
    and ``short`` are pairs: one :class:`CalibrationImage` under the name of the first; a file without its other half stands for
    itself. Colour becomes BGR, an alpha channel is dropped, grey stays grey, 16 bits become 8.

    Args:
        path: directory of images (png, jpg, bmp, tif), rosbag2 directory or bare ``.mcap``.
        poses: file for :func:`read_poses`; every image must have a pose then, and every pose an image.
        image_topic: of a bag.
        moments: at most so many of a bag.

    Raises:
        InputError: nothing is there, files cannot be read, their sizes differ, or poses and images do not match.
    """
    if not path.exists():
        raise InputError(f"'{path}' does not exist; expected a directory of images or a bag")
    if is_bag(path):
        if poses is not None:
            raise InputError(f"'{path}' is a bag, and poses ('{poses}') go by file names; expected a directory of images")
        return read_bag_images(path, image_topic, moments)
    if not path.is_dir():
        raise InputError(f"'{path}' is a file; expected a directory of images, a rosbag2 directory or an .mcap file")
    sources = _sources(path)
    T_base_tool = {} if poses is None else _match(read_poses(poses), sources, poses)
    files = [file for source in sources for file in source.files()]
    pixels = _read_all(files, path)
    return [
        CalibrationImage(
            source.name,
            pixels[source.board],
            None if source.stripe is None else pixels[source.stripe],
            T_base_tool.get(source.name),
        )
        for source in sources
    ]


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return what sorts names as people count: ``im2`` before ``im10``."""
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", name)]


def _sources(directory: Path) -> list[_Source]:
    folders = directory / _LONG, directory / _SHORT
    if all(folder.is_dir() for folder in folders):
        sources = _folder_pairs(*(_image_files(folder) for folder in folders))
    else:
        sources = _suffix_pairs(_image_files(directory))
    if not sources:
        raise InputError(f"'{directory}' holds no images; expected files {', '.join(sorted(_SUFFIXES))}")
    return sources


def _image_files(directory: Path) -> list[Path]:
    """Return the image files, naturally sorted; hidden ones are none."""
    files = (item for item in directory.iterdir() if item.is_file() and not item.name.startswith("."))
    return sorted((item for item in files if item.suffix.lower() in _SUFFIXES), key=lambda item: natural_key(item.name))


def _folder_pairs(long: Sequence[Path], short: Sequence[Path]) -> list[_Source]:
    stripes = {file.stem: file for file in short}
    sources = [_Source(file.name, file, stripes.pop(file.stem, None)) for file in long]
    return sources + [_Source(file.name, file) for file in stripes.values()]


def _suffix_pairs(files: Sequence[Path]) -> list[_Source]:
    by_stem = {file.stem: file for file in files}
    stripe_of: dict[str, str] = {}
    for stem in by_stem:
        for board_end, stripe_end in _PAIRS:
            other = stem.removesuffix(board_end) + stripe_end
            if stem.endswith(board_end) and other in by_stem:
                stripe_of.setdefault(stem, other)
    taken = set(stripe_of.values())
    return [
        _Source(file.name, file, by_stem[stripe_of[file.stem]] if file.stem in stripe_of else None)
        for file in files
        if file.stem not in taken
    ]


def _match(poses: Mapping[str, FloatArray], sources: Sequence[_Source], path: Path) -> dict[str, FloatArray]:
    """Return the poses by the name of their source; every one is used, and none is missing."""
    if not poses:
        raise InputError(f"poses '{path}' holds names but no poses; leave --poses away, or give each image its two lines before")
    by_file = {file.name: source.name for source in sources for file in source.files()}
    if strangers := [name for name in poses if name not in by_file]:
        raise InputError(f"poses '{path}' names {_some(strangers)}, of which there is no image; expected names of its files")
    found = {by_file[name]: T for name, T in poses.items()}
    if missing := [source.name for source in sources if source.name not in found]:
        raise InputError(f"{_some(missing)} of {len(sources)} images without a pose in '{path}'; add it, or take the image away")
    return found


def _read_all(files: Sequence[Path], directory: Path) -> dict[Path, ByteArray]:
    raw: dict[Path, AnyArray] = {}
    broken: list[str] = []
    for file in progress(files, len(files), "reading images"):
        pixels = _read(file)
        if pixels is None:
            broken.append(file.name)
        else:
            raw[file] = pixels
    if broken:
        raise InputError(
            f"{len(broken)} of {len(files)} images in '{directory}' cannot be read: {_some(broken)}; copy them again, or take "
            "them away"
        )
    _check_sizes(raw, directory)
    shift = _bits_beyond_8(raw.values())
    return {file: _eight_bits(pixels, shift) for file, pixels in raw.items()}


def _read(file: Path) -> AnyArray | None:
    """Return (H, W) or (H, W, 3) BGR of 8 or 16 bits; None for what is broken, or no image of that kind."""
    try:
        data = file.read_bytes()
        if data.startswith(_JPEG_START):
            return decode(EncodedImage(0, data, "jpeg", compressed=True)).pixels
    except (OSError, InputError):
        return None
    # Older OpenCVs give a truncated png a black rest.
    if not data or (data.startswith(_PNG_START) and _PNG_END not in data[-64:]):
        return None
    pixels = _quiet_decode(data)
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        return None
    return pixels[:, :, :3] if pixels.ndim == 3 else pixels


def _quiet_decode(data: bytes) -> AnyArray | None:
    """Decode without OpenCV's own lines on stderr: the error that follows says it in one."""
    # Older OpenCVs have the two functions in cv2 itself.
    logging = getattr(cv2.utils, "logging", cv2)
    level = logging.getLogLevel()
    logging.setLogLevel(0)
    try:
        return cast("AnyArray | None", cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))
    except cv2.error:
        return None
    finally:
        logging.setLogLevel(level)


def _bits_beyond_8(images: Iterable[AnyArray]) -> int:
    """Return by how many bits 16-bit images must be shifted: cameras store their 10, 12 or 14 bits at either end."""
    brightest = max((int(image.max()) for image in images if image.dtype == np.uint16), default=0)
    return max(0, brightest.bit_length() - 8)


def _eight_bits(pixels: AnyArray, shift: int) -> ByteArray:
    return np.ascontiguousarray(pixels if pixels.dtype == np.uint8 else (pixels >> shift).astype(np.uint8))


def _check_sizes(images: Mapping[Path, AnyArray], directory: Path) -> None:
    sizes = {file.name: (image.shape[1], image.shape[0]) for file, image in images.items()}
    counts = Counter(sizes.values()).most_common()
    if len(counts) > 1:
        (width, height), count = counts[0]
        odd = [f"{name} ({size[0]} x {size[1]})" for name, size in sizes.items() if size != (width, height)]
        raise InputError(
            f"images in '{directory}' differ in size: {count} are {width} x {height}, but not {_some(odd)}; expected images of "
            "one camera at one resolution"
        )


def _some(names: Sequence[str]) -> str:
    """Return a few of the names in quotes, and how many more there are."""
    more = f" and {len(names) - _NAMED_AT_MOST} more" if len(names) > _NAMED_AT_MOST else ""
    return ", ".join(f"'{name}'" for name in names[:_NAMED_AT_MOST]) + more
