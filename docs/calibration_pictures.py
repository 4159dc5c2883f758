"""The pictures of docs/calibration.md, from calibration data that ``vli simulate board`` makes: ``make calibration-pictures``.

    python docs/calibration_pictures.py [OUT]

Photographs are those of the simulated camera; drawings are cut out of the reports that the commands write.
"""

from __future__ import annotations

import base64
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from vli_bringup.cli import main as vli
from vli_common.arrays import ByteArray

BOARD = "chessboard:9x6:0.005"
SEED = 4
LIGHT = {"currentColor": "#3f3f3b", "var(--card)": "#ffffff"}
"""An image cannot take the page's colours: these read well on GitHub's white, on a ground of their own elsewhere."""
DRAWINGS = (
    ("residuals", "camera", "Residual of every corner"),
    ("depth", "laser", "Each stripe point of an image"),
    ("allan", "imu", "Gyroscope"),
)
"""Name, report, and how the caption of the drawing begins there."""
_GAP_PX = 6
_TILE_PX = 300


def prepare(work: Path) -> None:
    """Make data and reports as docs/calibration.md does."""
    data, file = work / "set", work / "scanner.yaml"
    run("simulate", "board", "--out", data, "--seed", SEED, "--images", 40, "--parts", "camera", "laser", "rest")
    set_apart(data / "laser", work / "others")
    common = ("--target", BOARD, "--calib", file)
    run("calibrate", "camera", data / "camera", "--target", BOARD, "--out", file, "--report", work / "camera")
    run("calibrate", "laser", data / "laser", *common, "--out", file, "--report", work / "laser")
    run("calibrate", "imu", data / "imu_rest", "--out", file, "--report", work / "imu")
    run("calibrate", "check", work / "others", *common, "--report", work / "check")


def set_apart(pairs: Path, others: Path) -> None:
    """Move every fourth pair to where the calibration does not see it, for the check: the simulator goes from near to far."""
    others.mkdir()
    for index, long in enumerate(sorted(pairs.glob("*_long.png"))):
        if index % 4 == 3:
            for file in (long, long.with_name(long.name.replace("_long", "_short"))):
                file.rename(others / file.name)


def draw(out: Path, work: Path) -> None:
    """Write the pictures into ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    write_sheet(out / "calibration-views.jpg", sorted((work / "set/camera").glob("*.png"))[:12], columns=4)
    pairs = sorted((work / "set/laser").glob("*.png"))
    write_sheet(out / "calibration-pairs.jpg", [*pairs[0:6:2], *pairs[1:6:2]], columns=3)
    for name, report, caption in DRAWINGS:
        write_drawing(out / f"calibration-{name}", work / report, caption)


def run(*words: object) -> None:
    """Run a command; end where it fails, it has said why."""
    if code := vli([str(word) for word in words]):
        sys.exit(code)


def write_sheet(path: Path, files: Sequence[Path], columns: int) -> None:
    """Write a contact sheet of images, row by row."""
    tiles = [_tile(file) for file in files]
    rows = [_joined(tiles[start : start + columns], axis=1) for start in range(0, len(tiles), columns)]
    cv2.imwrite(str(path), _joined(rows, axis=0), [cv2.IMWRITE_JPEG_QUALITY, 85])


def _tile(file: Path) -> ByteArray:
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
    scale = _TILE_PX / pixels.shape[1]
    return np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _joined(parts: Sequence[ByteArray], axis: int) -> ByteArray:
    gap = np.full_like(parts[0][: _GAP_PX if axis == 0 else None, : None if axis == 0 else _GAP_PX], 255)
    return np.concatenate([part for item in parts for part in (item, gap)][:-1], axis=axis)


def write_drawing(path: Path, report: Path, caption: str) -> None:
    """Cut the drawing whose caption begins so out of a report, as the SVG or the PNG that it is there."""
    page = (report / "report.html").read_text()
    drawings = re.findall(r'<div class="drawing">(.*?)\s*</div>\s*<figcaption>(.*?)</figcaption>', page, re.DOTALL)
    drawing = next((drawing for drawing, text in drawings if text.startswith(caption)), None)
    if drawing is None:
        sys.exit(f"'{report}' has no drawing '{caption}', but: {'; '.join(text for _, text in drawings)}")
    if png := re.search(r'src="data:image/png;base64,([^"]*)"', drawing):
        path.with_suffix(".png").write_bytes(base64.b64decode(png[1]))
    else:
        path.with_suffix(".svg").write_text(_alone(drawing))


def _alone(svg: str) -> str:
    """Return an SVG as a file of its own: with a ground, and without the page's colours."""
    for variable, colour in LIGHT.items():
        svg = svg.replace(variable, colour)
    ground = '<rect width="100%" height="100%" rx="4" fill="#ffffff"/>'
    start = svg.index(">") + 1
    return svg[:start].replace("<svg", f'<svg fill="{LIGHT["currentColor"]}"') + ground + svg[start:] + "\n"


def main() -> int:
    """Make the pictures beside this file, or where the argument says."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images"
    with tempfile.TemporaryDirectory() as work:
        prepare(Path(work))
        draw(out, Path(work))
    return 0


if __name__ == "__main__":
    sys.exit(main())
