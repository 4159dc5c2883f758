"""A calibration's report: one self-contained HTML file with its verdict, figures and pictures, and ``summary.json``."""

from __future__ import annotations

import base64
import functools
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import jinja2
import numpy as np

from vli_calibration.documents import write_atomically
from vli_calibration.tables import cell_text, is_figures
from vli_common.arrays import AnyArray, ByteArray
from vli_common.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.html"
SUMMARY = "summary.json"
_PICTURE_PX = 640
_JPEG_QUALITY = 85
_SVG_AT_MOST = 400_000
"""Bytes; a drawing of more, thousands of points, is smaller as pixels."""

_PNG_DPI = 160
_NAME_AT_MOST = 28
"""Characters; a longer cell is a sentence."""


class Verdict(Enum):
    """What a calibration is worth."""

    GOOD = "good"
    USABLE = "usable"
    BAD = "bad"


@dataclass(frozen=True)
class _Block:
    """One part of the page, drawn by the macro of that ``kind`` in the template."""

    kind: str
    values: dict[str, Any] = field(default_factory=dict)


class Report:
    """Collects what is to be said, in the order in which it is to be read, and writes it.

    The page begins with the verdict, wherever that was said. A good order for the rest: key figures, what to improve, then one
    heading for each detail.

    Args:
        title: of the page.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._verdict: tuple[Verdict, str] | None = None
        self._blocks: list[_Block] = []

    def verdict(self, level: Verdict, sentence: str) -> None:
        """Say what the calibration is worth, in words, and what to do about it; the level may stand before it and a colon."""
        self._verdict = level, sentence.removeprefix(f"{level.value}: ")

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._add("heading", text=text)

    def paragraph(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._add("paragraph", text=text)

    def bullets(self, items: Sequence[str]) -> None:
        """Add a list, of what to improve for instance; nothing where it is empty."""
        if items:
            self._add("bullets", items=list(items))

    def table(self, header: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "") -> None:
        """Add a table; columns of figures are set to the right, floats shown with four digits, None as a dash."""
        cells = [[cell_text(value) for value in row] for row in rows]
        columns = list(zip(*cells, strict=True)) if cells else [()] * len(header)
        self._add("table", header=list(header), rows=cells, styles=[_style(column) for column in columns], caption=caption)

    def figure(self, figure: Figure, caption: str) -> None:
        """Add a drawing: as SVG in the colours of the page, as PNG where that is smaller."""
        svg = _svg(figure, len(self._blocks))
        if len(svg) <= _SVG_AT_MOST:
            self._add("figure", svg=svg, caption=caption)
        else:
            self._add("figure", source=_data_uri("png", _png(figure)), caption=caption)

    def picture(self, pixels: ByteArray, caption: str) -> None:
        """Add an image (H, W) or (H, W, 3) BGR, reduced to at most 640 px."""
        self._add("picture", source=_data_uri("jpeg", _jpeg(pixels)), caption=caption)

    def write(self, directory: Path, summary: Mapping[str, object]) -> None:
        """Write ``report.html`` and ``summary.json``; the verdict is added to the summary.

        Raises:
            OutputError: they cannot be written.
        """
        figures: dict[str, object] = dict(summary)
        if self._verdict is not None:
            figures |= {"verdict": self._verdict[0].value, "verdict_text": self._verdict[1]}
        page = self.html()
        write_atomically(directory / PAGE, page.encode())
        write_atomically(directory / SUMMARY, (json.dumps(_plain(figures), indent=1, ensure_ascii=False) + "\n").encode())

    def html(self) -> str:
        """Return the page."""
        level, sentence = self._verdict or (None, "")
        return _template().render(
            title=self._title,
            level=level.value if level else "",
            sentence=sentence,
            blocks=self._blocks,
            date=datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        )

    def _add(self, kind: str, **values: Any) -> None:
        self._blocks.append(_Block(kind, values))


def make_figure(width: float = 7.0, height: float = 3.6) -> Figure:
    """Return an empty drawing of the reports' size, inches, without pyplot's global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _style(cells: Sequence[str]) -> str:
    """Return the class of a column: figures to the right, sentences broken into lines, names never."""
    if is_figures(cells):
        return "right"
    return "sentence" if any(len(cell) > _NAME_AT_MOST for cell in cells) else ""


@functools.cache
def _template() -> jinja2.Template:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.get_template("report_template.html")


def _svg(figure: Figure, number: int) -> str:
    """Return the drawing as an SVG element whose black is the text's colour and whose white is the page's."""
    from matplotlib import rc_context

    stream = io.StringIO()
    _restyle(figure)
    with rc_context({"svg.hashsalt": f"report-{number}", "svg.fonttype": "path"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # Glyphs are shared by name, and a page has several drawings: the names of each must be its own.
    text = re.sub(r'(id="|"#|url\(#)', rf"\g<1>f{number}-", text)
    return re.sub(r"#(?:000000|262626)\b", "currentColor", text).replace("#ffffff", "var(--card)")


def _restyle(figure: Figure) -> None:
    """Take away what reports do without: backgrounds, legends' frames, the upper and right edge."""
    figure.patch.set_facecolor("none")
    for axes in figure.axes:
        axes.patch.set_facecolor("none")
        if not axes.images and axes.get_label() != "<colorbar>" and axes.name == "rectilinear":
            axes.spines[["top", "right"]].set_visible(False)
        if legend := axes.get_legend():
            legend.set_frame_on(False)


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=_PNG_DPI, facecolor="white")
    return stream.getvalue()


def _jpeg(pixels: ByteArray) -> bytes:
    scale = min(1.0, _PICTURE_PX / max(pixels.shape[:2]))
    small: AnyArray = pixels if scale == 1 else cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise InputError(f"an image of shape '{pixels.shape}' cannot be shown in the report; expected (H, W) or (H, W, 3) uint8")
    return data.tobytes()


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _plain(value: object) -> object:
    """Return nested values as JSON has them; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value
