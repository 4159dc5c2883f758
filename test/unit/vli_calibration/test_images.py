from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from vli_calibration.images import natural_key, read_images
from vli_common.errors import InputError

RNG = np.random.default_rng(1)
COLOUR = RNG.integers(0, 255, (12, 16, 3), dtype=np.uint8)
GREY = RNG.integers(0, 255, (12, 16), dtype=np.uint8)


def save(directory, **images):
    """Write images by name; ``__`` stands for the dot before the suffix."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, pixels in images.items():
        assert cv2.imwrite(str(directory / name.replace("__", ".")), pixels)
    return directory


def poses(path, *names):
    path.write_text("".join(f"[{index}.0, 0.0, 0.5]\n[0.0, 0.0, 0.0, 1.0]\n{name}\n" for index, name in enumerate(names)))
    return path


def test_images_come_in_the_order_people_count_in(tmp_path):
    save(tmp_path, im10__png=GREY, im2__png=GREY, im1__png=GREY, Im3__png=GREY)
    assert [image.name for image in read_images(tmp_path)] == ["im1.png", "im2.png", "Im3.png", "im10.png"]


def test_natural_order_bears_digits_that_are_no_numbers():
    assert sorted(["a²", "a10", "a9", "10", "b"], key=natural_key) == ["10", "a9", "a10", "a²", "b"]


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "PNG"])
def test_colour_becomes_bgr_and_grey_stays_grey(tmp_path, suffix):
    save(tmp_path, **{f"a__{suffix}": COLOUR, f"b__{suffix}": GREY})
    colour, grey = read_images(tmp_path)
    np.testing.assert_array_equal(colour.pixels, COLOUR)
    np.testing.assert_array_equal(grey.pixels, GREY)


def test_jpeg_colours_stay_in_their_order(tmp_path):
    blue = np.zeros((16, 16, 3), np.uint8)
    blue[..., 0] = 200
    save(tmp_path, a__jpg=blue)
    mean = read_images(tmp_path)[0].pixels.mean(axis=(0, 1))
    assert mean[0] > 180
    assert mean[2] < 20


def test_an_alpha_channel_is_dropped(tmp_path):
    save(tmp_path, a__png=np.dstack([COLOUR, GREY]))
    np.testing.assert_array_equal(read_images(tmp_path)[0].pixels, COLOUR)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_sixteen_bits_become_eight_wherever_the_camera_puts_its_own(tmp_path, bits):
    levels = np.uint16(2 ** (bits - 8))
    full = GREY.astype(np.uint16)
    full[0, 0] = 255
    save(tmp_path, bright__png=full * levels, dim__png=full // 4 * levels)
    bright, dim = read_images(tmp_path)
    np.testing.assert_array_equal(bright.pixels, full)
    np.testing.assert_array_equal(dim.pixels, full // 4)


@pytest.mark.parametrize(("board", "stripe"), [("7_long", "7_short"), ("7_off", "7_on"), ("7", "7_laser")])
def test_two_exposures_of_a_scene_are_one_image(tmp_path, board, stripe):
    save(tmp_path, **{f"{board}__png": COLOUR, f"{stripe}__bmp": 255 - COLOUR, "8__png": GREY})
    images = {image.name: image for image in read_images(tmp_path)}
    assert set(images) == {f"{board}.png", "8.png"}
    np.testing.assert_array_equal(images[f"{board}.png"].pixels, COLOUR)
    np.testing.assert_array_equal(images[f"{board}.png"].stripe_pixels, 255 - COLOUR)
    assert images["8.png"].stripe_pixels is None


def test_a_stripe_image_without_its_other_half_stands_for_itself(tmp_path):
    save(tmp_path, a_long__png=GREY, a_short__png=GREY, b_short__png=GREY)
    assert [(image.name, image.stripe_pixels is None) for image in read_images(tmp_path)] == [
        ("a_long.png", False),
        ("b_short.png", True),
    ]


def test_folders_long_and_short_hold_pairs_by_name(tmp_path):
    save(tmp_path / "long", a__png=COLOUR, b__png=GREY)
    save(tmp_path / "short", a__png=255 - COLOUR, c__png=GREY)
    images = read_images(tmp_path)
    assert [image.name for image in images] == ["a.png", "b.png", "c.png"]
    np.testing.assert_array_equal(images[0].stripe_pixels, 255 - COLOUR)
    assert images[1].stripe_pixels is None


def test_poses_go_with_their_images_whatever_the_order(tmp_path):
    save(tmp_path, im1__png=GREY, im2__png=GREY)
    images = read_images(tmp_path, poses(tmp_path / "data.txt", "im2.png", "im1.png"))
    assert [image.T_base_tool[0, 3] for image in images] == [1.0, 0.0]


def test_the_pose_of_a_pair_may_be_named_after_either_half(tmp_path):
    save(tmp_path, a_off__png=GREY, a_on__png=GREY)
    assert read_images(tmp_path, poses(tmp_path / "p.txt", "a_on.png"))[0].T_base_tool is not None


def test_without_being_asked_poses_are_not_read(tmp_path):
    save(tmp_path, im1__png=GREY)
    (tmp_path / "data.txt").write_text("nonsense")
    assert read_images(tmp_path)[0].T_base_tool is None


def test_hidden_files_and_others_are_no_images(tmp_path):
    save(tmp_path, a__png=GREY)
    (tmp_path / "._a.png").write_bytes(b"resource fork")
    (tmp_path / "readme.md").write_text("x")
    assert len(read_images(tmp_path)) == 1


def refusal(*args, **options):
    with pytest.raises(InputError) as caught:
        read_images(*args, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_is_not_there_is_refused(tmp_path):
    assert re.search(r"'.*none' does not exist; expected a directory of images or a bag", refusal(tmp_path / "none"))


def test_a_directory_without_images_is_refused(tmp_path):
    assert "holds no images; expected files .bmp, .jpeg, .jpg, .png" in refusal(tmp_path)


def test_a_file_that_is_no_bag_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    assert "is a file; expected a directory of images" in refusal(tmp_path / "a.png")


def test_broken_files_are_named_and_say_nothing_else_on_stderr(tmp_path, capfd):
    save(tmp_path, good__png=COLOUR, cut__png=COLOUR, cut__jpg=COLOUR, cut__tif=COLOUR, cut__bmp=COLOUR)
    for suffix in ("png", "jpg", "tif", "bmp"):
        file = tmp_path / f"cut.{suffix}"
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    (tmp_path / "empty.png").touch()
    line = refusal(tmp_path)
    assert line.startswith("5 of 6 images in")
    for name in ("cut.png", "cut.jpg", "cut.tif", "cut.bmp", "empty.png"):
        assert f"'{name}'" in line
    assert capfd.readouterr().err == ""


def test_images_of_different_sizes_are_refused_by_name(tmp_path):
    save(tmp_path, a__png=GREY, b__png=GREY, c__png=GREY[:6])
    line = refusal(tmp_path)
    assert "2 are 16 x 12" in line
    assert "'c.png (16 x 6)'" in line


def test_an_image_without_a_pose_is_refused_by_name(tmp_path):
    save(tmp_path, im1__png=GREY, im2__png=GREY)
    assert "'im2.png' of 2 images without a pose" in refusal(tmp_path, poses(tmp_path / "data.txt", "im1.png"))


def test_a_pose_without_an_image_is_refused_by_name(tmp_path):
    save(tmp_path, im1__png=GREY)
    assert "names 'im9.png', of which there is no image" in refusal(tmp_path, poses(tmp_path / "d.txt", "im1.png", "im9.png"))


def test_a_list_of_names_gives_no_poses(tmp_path):
    save(tmp_path, im1__png=GREY)
    (tmp_path / "data.txt").write_text("im1.png\n")
    assert "holds names but no poses; leave --poses away" in refusal(tmp_path, tmp_path / "data.txt")


def test_the_real_sets_are_read_as_they_are(shared_data):
    directory = shared_data / "blaser_calibration"
    unified = read_images(directory / "640_unified", directory / "640_unified" / "data.txt")
    assert [image.name for image in unified] == [f"im{index}.png" for index in range(25)]
    assert all(image.pixels.shape == (480, 640, 3) and image.T_base_tool is not None for image in unified)
    handheld = read_images(directory / "handheld_1280x720")
    assert [image.name for image in handheld] == [f"im{index}.png" for index in range(1, 37)]
    assert {image.pixels.shape for image in handheld} == {(720, 1280, 3)}
