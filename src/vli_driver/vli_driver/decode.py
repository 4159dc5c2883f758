"""Encoded images to pixels: BGR or grey, 8 bit."""

from __future__ import annotations

import re
import struct
from typing import Literal, cast

import cv2
import numpy as np
import simplejpeg

from vli_common.arrays import AnyArray, ByteArray
from vli_common.errors import InputError
from vli_common.types import EncodedImage, Image

Route = Literal["native", "grey"]
"""``native``: BGR where the source has colour; ``grey``: luminance only, which saves the colour planes of a jpeg."""

# ROS names a mosaic by its first two pixels of row 0, OpenCV by pixels (1, 1) and (1, 2): the names are swapped pairwise.
_BAYER_TO_BGR = {
    "rggb": cv2.COLOR_BayerBG2BGR,
    "bggr": cv2.COLOR_BayerRG2BGR,
    "gbrg": cv2.COLOR_BayerGR2BGR,
    "grbg": cv2.COLOR_BayerGB2BGR,
}
_CHANNELS = {"mono": 1, "rgb": 3, "bgr": 3, "bayer": 1}
_ENCODING = re.compile(r"(?P<kind>mono|rgb|bgr|bayer)(?:_(?P<pattern>rggb|bggr|gbrg|grbg))?(?P<bits>8|16)")
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG"
_PNG_START = 8
_PNG_HEADER, _PNG_CHUNK = struct.Struct(">I4sII"), struct.Struct(">I8x")
"""Length, name, width and height of the first part; length of any part, with room for its name and checksum."""
MAX_PIXELS = 2**26
"""Of a compressed image: a short header may claim any size, and memory for it is taken before the data are looked at."""
_VALID = "bayer_{rggb,bggr,gbrg,grbg}{8,16}, rgb8, bgr8, mono8, rgb16, bgr16, mono16"


def decode(image: EncodedImage, route: Route = "native") -> Image:
    """Return the pixels of an image.

    Args:
        image: as it came from the source.
        route: see :data:`Route`.

    Raises:
        InputError: an unknown encoding, broken data or a size that does not fit.
    """
    try:
        pixels = _decode_compressed(image, route) if image.compressed else _decode_raw(image)
    except (cv2.error, MemoryError) as error:
        why = " ".join(str(error).split())[:200]
        raise InputError(
            f"image of encoding '{image.encoding[:40]}', {len(image.data)} bytes, cannot be decoded: {why}"
        ) from error
    if route == "grey" and pixels.ndim == 3:
        pixels = cast(ByteArray, cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
    return Image(image.stamp_ns, pixels, exposure_s=image.exposure_s, laser_on=image.laser_on)


def _decode_raw(image: EncodedImage) -> ByteArray:
    kind, pattern, bits = _parse(image.encoding)
    size = bits // 8
    row = image.width * _CHANNELS[kind] * size
    if image.width <= 0 or image.height <= 0 or image.step < row or len(image.data) < image.step * (image.height - 1) + row:
        raise InputError(
            f"image of encoding '{image.encoding[:40]}' has '{len(image.data)}' bytes for {image.width} x {image.height} with "
            f"step {image.step}; expected {max(image.step, row) * image.height} bytes"
        )
    rows = np.lib.stride_tricks.as_strided(
        np.frombuffer(image.data, np.uint8), (image.height, row), (image.step, 1), writeable=False
    )
    pixels: AnyArray = rows if size == 1 else _eight_bits(np.ascontiguousarray(rows).view("<u2"))
    if _CHANNELS[kind] == 3:
        pixels = pixels.reshape(image.height, image.width, 3)
    return _to_bgr(pixels, kind, pattern)


def _decode_compressed(image: EncodedImage, route: Route) -> ByteArray:
    mosaic = _ENCODING.search(image.encoding)
    if image.data[:2] == _JPEG:
        pixels: AnyArray = _decode_jpeg(image, route if mosaic is None or mosaic["kind"] != "bayer" else "grey")
    elif image.data[:4] == _PNG:
        pixels = _decode_png(image)
    else:
        raise InputError(
            f"compressed image of format '{image.encoding[:40]}' starts with '{image.data[:4].hex()}', expected a jpeg or a png"
        )
    if pixels.ndim == 2 and mosaic is not None and mosaic["kind"] == "bayer":
        return _to_bgr(pixels, "bayer", mosaic["pattern"])
    return pixels


def _decode_jpeg(image: EncodedImage, route: Route) -> ByteArray:
    # libjpeg-turbo's accurate transform: the fast one differs by one grey level on average, more than the stripe's noise allows.
    try:
        height, width, space = simplejpeg.decode_jpeg_header(image.data)[:3]
        _check_claim(image, width, height)
        grey = route == "grey" or space == "Gray"
        pixels = simplejpeg.decode_jpeg(image.data, "GRAY" if grey else "BGR")
    except ValueError as error:
        raise InputError(f"jpeg of {len(image.data)} bytes, format '{image.encoding[:40]}', is broken: {error}") from error
    return cast(ByteArray, pixels[:, :, 0] if grey else pixels)


def _decode_png(image: EncodedImage) -> ByteArray:
    _check_png(image)
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    if pixels is None:
        raise InputError(f"png of {len(image.data)} bytes, format '{image.encoding[:40]}', is broken; record again")
    return cast(ByteArray, pixels) if pixels.dtype == np.uint8 else _eight_bits(pixels)


def _check_png(image: EncodedImage) -> None:
    """Raise where the size, or the length of a chunk, is more than there can be: the decoder would take memory for it."""
    data, at = image.data, _PNG_START
    name, width, height = _PNG_HEADER.unpack_from(data, at)[1:] if len(data) >= at + _PNG_HEADER.size else (b"", 0, 0)
    if name != b"IHDR":
        raise InputError(f"png of {len(data)} bytes, format '{image.encoding[:40]}', is broken: it has no header; record again")
    _check_claim(image, width, height)
    while at + _PNG_CHUNK.size <= len(data):
        (length,) = _PNG_CHUNK.unpack_from(data, at)
        if length > len(data) - at:
            raise InputError(
                f"png of {len(data)} bytes, format '{image.encoding[:40]}', is cut: a part of it has '{length}' bytes"
            )
        at += _PNG_CHUNK.size + length


def _check_claim(image: EncodedImage, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise InputError(
            f"compressed image of {len(image.data)} bytes claims to be '{width} x {height}', expected at most {MAX_PIXELS} pixels"
        )


def _to_bgr(pixels: AnyArray, kind: str, pattern: str | None) -> ByteArray:
    if kind == "bayer":
        return cast(ByteArray, cv2.cvtColor(np.ascontiguousarray(pixels), _BAYER_TO_BGR[str(pattern)]))
    if kind == "rgb":
        return cast(ByteArray, cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
    return np.ascontiguousarray(pixels)


def _parse(encoding: str) -> tuple[str, str | None, int]:
    match = _ENCODING.fullmatch(encoding)
    if match is None or (match["kind"] == "bayer") != (match["pattern"] is not None):
        raise InputError(f"image encoding '{encoding[:40]}' is not supported; expected one of {_VALID}")
    return match["kind"], match["pattern"], int(match["bits"])


def _eight_bits(pixels: AnyArray) -> ByteArray:
    """Return the upper eight of sixteen bits (ROS scales 16-bit encodings to the full range)."""
    return (pixels >> 8).astype(np.uint8)
