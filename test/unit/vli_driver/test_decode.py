"""Every encoding against the pixels it was made from."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from vli_common.arrays import AnyArray, ByteArray
from vli_common.errors import InputError
from vli_common.types import EncodedImage
from vli_driver.decode import decode

H, W = 32, 48
BGR = (40, 90, 200)
"""Of a plain colour: a demosaicing with channels swapped shows at once."""

PATTERNS = ["rggb", "bggr", "gbrg", "grbg"]


def colour_image() -> ByteArray:
    """Return a smooth colour image (H, W, 3) BGR."""
    ramp = np.linspace(0.5, 1.0, W)[None, :, None]
    return np.broadcast_to(np.array(BGR) * ramp, (H, W, 3)).astype(np.uint8).copy()


def mosaic(pattern: str, pixels: ByteArray) -> ByteArray:
    """Return what a sensor sees whose first row begins with the pattern's first two letters, as REP 118 defines the names."""
    out = np.empty(pixels.shape[:2], np.uint8)
    for k, letter in enumerate(pattern):
        out[k // 2 :: 2, k % 2 :: 2] = pixels[k // 2 :: 2, k % 2 :: 2, "bgr".index(letter)]
    return out


def raw(encoding: str, pixels: AnyArray, padding: int = 0) -> EncodedImage:
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return EncodedImage(1, rows.tobytes(), encoding, pixels.shape[1], pixels.shape[0], rows.shape[1])


def packed(form: str, suffix: str, pixels: AnyArray) -> EncodedImage:
    return EncodedImage(1, cv2.imencode(suffix, pixels, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes(), form, compressed=True)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "convert"),
    [
        ("bgr8", lambda p: p),
        ("rgb8", lambda p: p[:, :, ::-1]),
        ("bgr16", lambda p: p.astype("<u2") << 8),
        ("rgb16", lambda p: p[:, :, ::-1].astype("<u2") << 8),
    ],
)
def test_colour_comes_out_as_bgr(encoding: str, convert: object, padding: int) -> None:
    pixels = decode(raw(encoding, convert(colour_image()), 2 * padding)).pixels  # type: ignore[operator]
    np.testing.assert_array_equal(pixels, colour_image())


@pytest.mark.parametrize(("encoding", "shift"), [("mono8", 0), ("mono16", 8)])
def test_grey_stays_grey(encoding: str, shift: int) -> None:
    grey = colour_image()[:, :, 2]
    pixels = decode(raw(encoding, grey.astype("<u2") << shift if shift else grey, 4)).pixels
    np.testing.assert_array_equal(pixels, grey)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("bits", [8, 16])
def test_a_mosaic_is_named_by_its_first_pixels(pattern: str, bits: int) -> None:
    sensor = mosaic(pattern, colour_image())
    image = raw(f"bayer_{pattern}{bits}", sensor.astype("<u2") << 8 if bits == 16 else sensor)
    error = decode(image).pixels[2:-2, 2:-2].astype(int) - colour_image()[2:-2, 2:-2]
    assert np.abs(error).max() <= 3


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("suffix", "kind"), [(".png", "png"), (".jpg", "jpeg")])
def test_a_packed_mosaic_is_told_by_the_format(pattern: str, suffix: str, kind: str) -> None:
    flat = np.broadcast_to(np.array(BGR, np.uint8), (H, W, 3))
    pixels = decode(packed(f"bayer_{pattern}8; {kind} compressed", suffix, mosaic(pattern, flat))).pixels
    assert np.abs(pixels[2:-2, 2:-2].astype(int) - BGR).max() <= (0 if suffix == ".png" else 12)


@pytest.mark.parametrize("form", ["jpeg", "bgr8; jpeg compressed bgr8", ""])
def test_a_jpeg_is_colour_or_grey_as_it_was_made(form: str) -> None:
    assert np.abs(decode(packed(form, ".jpg", colour_image())).pixels.astype(int) - colour_image()).max() <= 8
    assert decode(packed(form, ".jpg", colour_image()[:, :, 1])).pixels.shape == (H, W)


def test_a_sixteen_bit_png_keeps_its_upper_bits() -> None:
    grey = colour_image()[:, :, 2]
    np.testing.assert_array_equal(decode(packed("mono16; png compressed", ".png", grey.astype(np.uint16) << 8)).pixels, grey)


def test_the_grey_route_gives_luminance() -> None:
    expected = cv2.cvtColor(colour_image(), cv2.COLOR_BGR2GRAY).astype(int)
    for image in (packed("jpeg", ".jpg", colour_image()), raw("bgr8", colour_image())):
        assert np.abs(decode(image, "grey").pixels - expected).max() <= 3


def test_stamp_and_exposure_are_kept() -> None:
    image = EncodedImage(5, bytes(4), "mono8", 2, 2, 2, exposure_s=0.005, laser_on=False)
    decoded = decode(image)
    assert (decoded.stamp_ns, decoded.exposure_s, decoded.laser_on) == (5, 0.005, False)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (EncodedImage(1, bytes(16), "yuv422", 4, 4, 4), "encoding 'yuv422' is not supported; expected one of bayer_"),
        (EncodedImage(1, bytes(16), "bayer8", 4, 4, 4), "encoding 'bayer8' is not supported"),
        (EncodedImage(1, bytes(15), "mono8", 4, 4, 4), "has '15' bytes for 4 x 4 with step 4; expected 16 bytes"),
        (EncodedImage(1, bytes(16), "bgr8", 4, 4, 4), "has '16' bytes .* expected 48 bytes"),
        (EncodedImage(1, b"", "mono8", 0, 0, 0), "has '0' bytes"),
        (EncodedImage(1, b"\xff\xd8broken", "jpeg", compressed=True), "jpeg of 8 bytes, format 'jpeg', is broken"),
        (EncodedImage(1, b"\x89PNGbroken", "png", compressed=True), "png of 10 bytes, format 'png', is broken"),
        (EncodedImage(1, b"GIF89a", "gif", compressed=True), "starts with '47494638', expected a jpeg or a png"),
    ],
)
def test_what_cannot_be_decoded_is_said(image: EncodedImage, message: str) -> None:
    with pytest.raises(InputError, match=message):
        decode(image)


def png_part(name: bytes, body: bytes, length: int | None = None) -> bytes:
    checked = name + body
    return struct.pack(">I", len(body) if length is None else length) + checked + struct.pack(">I", zlib.crc32(checked))


def png_of(width: int, height: int, *parts: bytes) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + png_part(b"IHDR", struct.pack(">II5B", width, height, 8, 2, 0, 0, 0)) + b"".join(parts)


def jpeg_of(width: int, height: int) -> bytes:
    data = bytearray(packed("jpeg", ".jpg", colour_image()).data)
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (png_of(50_000, 50_000, png_part(b"IDAT", zlib.compress(b""))), "claims to be '50000 x 50000', expected at most"),
        (png_of(2**31 - 1, 2**31 - 1), "claims to be '2147483647 x 2147483647'"),
        (png_of(4, 4, png_part(b"IDAT", b"", length=2**31 - 1)), "is cut: a part of it has '2147483647' bytes"),
        (png_of(4, 4, png_part(b"junk", b"x" * 9)), "is broken"),
        (b"\x89PNG\r\n\x1a\n" + png_part(b"IDAT", b"x" * 30), "is broken: it has no header"),
        (jpeg_of(65_500, 65_500), "claims to be '65500 x 65500', expected at most"),
    ],
    ids=["png of 2.5 Gpx", "png of 4 Epx", "part of 2 GB", "no data", "no header", "jpeg of 4 Gpx"],
)
def test_an_image_that_claims_more_than_it_can_be_takes_no_memory(data: bytes, message: str) -> None:
    tracemalloc.start()
    with pytest.raises(InputError, match=message):
        decode(EncodedImage(1, data, "x", compressed=True))
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()
