from __future__ import annotations

import cv2
import numpy as np
import pytest
from recordings import START_NS, image, imu, write, write_mcap

from vli_calibration.bag_images import motion_px
from vli_calibration.images import read_images
from vli_common.errors import InputError

PERIOD_NS = 33_333_333
SIZE = (96, 128)


def texture(shift_px: float, gain: float = 1.0) -> np.ndarray:
    """Return a blurred noise pattern, moved sideways."""
    big = np.random.default_rng(3).integers(0, 255, (SIZE[0], 2 * SIZE[1]), dtype=np.uint8)
    big = cv2.normalize(cv2.GaussianBlur(big, (0, 0), 3), None, 20, 235, cv2.NORM_MINMAX)
    moved = cv2.warpAffine(big, np.array([[1.0, 0, -shift_px], [0, 1, 0]]), SIZE[::-1], flags=cv2.INTER_LINEAR)
    return np.rint(moved * gain).astype(np.uint8)


def moving(stops: int, frames_between: int = 10, frames_at_rest: int = 6) -> list[float]:
    """Return shifts of a camera that moves 4 px a frame and rests now and then."""
    shifts, here = [], 0.0
    for _ in range(stops):
        for _ in range(frames_between):
            here += 4.0 if here < 100 else -100.0
            shifts.append(here)
        shifts += [here] * frames_at_rest
    return shifts


def alternating(shifts: list[float]):
    """Yield long frames of the texture, short ones dark, as messages."""
    for index, shift in enumerate(shifts):
        for half, gain in ((0, 1.0), (1, 0.05)):
            ns = START_NS + (2 * index + half) * PERIOD_NS // 2
            yield ns, "/camera/image_raw", image(ns, pixels=texture(shift, gain))


@pytest.fixture(scope="module")
def rests(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "rests.mcap"
    return write_mcap(path, alternating(moving(stops=5)))


def test_the_moments_chosen_are_those_at_rest(rests):
    images = read_images(rests, moments=5)
    assert 4 <= len(images) <= 5
    frames = [round(float(image.name.removesuffix(" s")) * 1e9 / PERIOD_NS) for image in images]
    # Ten frames of motion, then six at rest; the first of the six follows a motion.
    assert all(frame % 16 >= 10 for frame in frames)


def test_each_long_exposure_comes_with_the_short_one_beside_it(rests):
    for item in read_images(rests, moments=5):
        assert item.stripe_pixels is not None
        assert item.pixels.mean() > 10 * item.stripe_pixels.mean()


def test_a_camera_that_never_moves_gives_one_image(tmp_path):
    path = write_mcap(tmp_path / "rest.mcap", alternating([3.0] * 40))
    assert len(read_images(path, moments=8)) == 1


def test_never_more_moments_than_asked_for(rests):
    assert len(read_images(rests, moments=3)) <= 3


def test_a_stream_without_a_laser_has_no_second_exposure(tmp_path):
    messages = ((ns, "/cam", image(ns, pixels=texture(k))) for k in range(60) if (ns := START_NS + k * PERIOD_NS))
    write(tmp_path / "bag", messages)
    images = read_images(tmp_path / "bag", image_topic="/cam", moments=6)
    assert images
    assert all(item.stripe_pixels is None for item in images)


def test_a_frame_of_another_size_is_passed_over(tmp_path):
    messages = list(alternating([float(k) for k in range(20)]))
    ns = messages[7][0]
    messages[7] = (ns, "/camera/image_raw", image(ns, pixels=texture(0)[:40]))
    images = read_images(write_mcap(tmp_path / "odd.mcap", messages), moments=6)
    assert {item.pixels.shape for item in images} == {SIZE}


def test_frames_that_cannot_be_decoded_say_why_where_there_are_no_others(tmp_path):
    messages = [(START_NS, "/camera/image_raw", image(START_NS, encoding="yuv422"))]
    with pytest.raises(InputError, match="encoding 'yuv422' is not supported"):
        read_images(write_mcap(tmp_path / "yuv.mcap", messages))


def test_a_bag_without_images_is_refused(tmp_path):
    path = write_mcap(tmp_path / "imu.mcap", [(START_NS, "/imu", imu(START_NS))])
    with pytest.raises(InputError, match="has no image topic"):
        read_images(path)


def test_poses_do_not_go_with_a_bag(rests, tmp_path):
    with pytest.raises(InputError, match=r"is a bag, and poses .* go by file names"):
        read_images(rests, tmp_path / "data.txt")


def test_motion_is_measured_in_pixels():
    still, moved = (texture(shift).astype(np.float32) for shift in (0.0, 0.5))
    assert motion_px(still, still) == 0
    assert motion_px(still, moved) == pytest.approx(0.5, rel=0.25)
