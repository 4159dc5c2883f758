from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from vli_calibration.report import Report, Verdict, make_figure
from vli_calibration.tables import cell_text, text_table
from vli_common.errors import OutputError

VOID = {"meta", "img", "br", "path", "use"}


class Page(HTMLParser):
    """Elements of a page: tags in order, and whether each is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))


def drawing(points: int = 20):
    figure = make_figure()
    axes = figure.subplots()
    axes.scatter(*np.random.default_rng(0).normal(size=(2, points)), label="<points>")
    axes.legend()
    return figure


@pytest.fixture
def report():
    report = Report("Camera <of> & mine")
    report.heading("Residuals")
    report.table(["image", "RMS", "corners"], [["im1.png", 0.23456, 54], ["<im2>", None, 3]], "by image")
    report.figure(drawing(), "one drawing")
    report.figure(drawing(), "another")
    report.picture(np.zeros((1000, 2000, 3), np.uint8), "im1 <b>")
    report.picture(np.zeros((10, 20), np.uint8), "im2")
    report.verdict(Verdict.BAD, "take more tilted views at 60–100 mm")
    return report


def test_the_page_is_well_formed_and_needs_nothing_from_elsewhere(report):
    page = Page(report.html())
    assert page.open == []
    links = [value for _, attrs in page.tags for key, value in attrs.items() if key in ("src", "href")]
    assert links
    assert all(link.startswith("data:") for link in links)
    assert not any(tag in ("script", "link", "iframe") for tag, _ in page.tags)


def test_the_verdict_comes_first_whenever_it_was_said(report):
    text = report.html()
    assert text.index("take more tilted views") < text.index("<h2>")
    assert 'class="verdict bad"' in text


def test_names_are_text_never_markup(report):
    text = report.html()
    assert "Camera &lt;of&gt; &amp; mine" in text
    assert "&lt;im2&gt;" in text
    assert "im1 &lt;b&gt;" in text


def test_figures_stand_to_the_right_and_names_to_the_left(report):
    text = report.html()
    assert '<td>im1.png</td><td class="right">0.2346</td><td class="right">54</td>' in text
    assert '<td class="right">–</td>' in text


def test_the_parts_of_one_drawing_are_not_those_of_another(report):
    names = [attrs["id"] for _, attrs in Page(report.html()).tags if "id" in attrs]
    assert len(names) == len(set(names))
    assert len(names) > 20


def test_references_within_a_drawing_lead_somewhere(report):
    text = report.html()
    names = set(re.findall(r'id="([^"]+)"', text))
    wanted = set(re.findall(r'xlink:href="#([^"]+)"', text)) | set(re.findall(r"url\(#([^)]+)\)", text))
    assert wanted
    assert wanted <= names


def test_a_drawing_takes_the_colours_of_the_page(report):
    svg = re.findall(r"<svg.*?</svg>", report.html(), re.DOTALL)[0]
    assert "currentColor" in svg
    assert "#000000" not in svg
    assert "#ffffff" not in svg


def test_a_drawing_of_thousands_of_points_becomes_pixels():
    report = Report("many")
    report.figure(drawing(20_000), "many")
    text = report.html()
    assert "<svg" not in text
    assert "data:image/png;base64," in text


def test_pictures_are_reduced(report):
    sources = [attrs["src"] for tag, attrs in Page(report.html()).tags if tag == "img"]
    shapes = [
        cv2.imdecode(np.frombuffer(base64.b64decode(source.partition(",")[2]), np.uint8), cv2.IMREAD_UNCHANGED).shape[:2]
        for source in sources
    ]
    assert shapes == [(320, 640), (10, 20)]


def test_page_and_summary_are_written_together(report, tmp_path):
    report.write(tmp_path / "a" / "report", {"plane": np.array([0.0, 1.0]), "rms": np.float64("nan"), "n": np.int64(3)})
    assert {item.name for item in (tmp_path / "a" / "report").iterdir()} == {"report.html", "summary.json"}
    assert json.loads((tmp_path / "a" / "report" / "summary.json").read_text()) == {
        "plane": [0.0, 1.0],
        "rms": None,
        "n": 3,
        "verdict": "bad",
        "verdict_text": "take more tilted views at 60–100 mm",
    }


def test_a_report_replaces_the_one_before(report, tmp_path):
    report.write(tmp_path, {"n": 1})
    report.write(tmp_path, {"n": 2})
    assert json.loads((tmp_path / "summary.json").read_text())["n"] == 2


def test_a_place_that_cannot_be_written_is_said(report, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        report.write(tmp_path / "file", {})


def test_a_report_without_a_verdict_has_no_box():
    assert '<div class="verdict' not in Report("plain").html()


def test_the_table_for_the_terminal_lines_its_columns_up():
    lines = text_table(["image", "RMS", "why"], [["im1.png", 0.5, "–"], ["im10.png", 12.25, "stripe"]]).splitlines()
    assert lines == [
        "image       RMS  why",
        "--------  -----  ------",
        "im1.png     0.5  –",
        "im10.png  12.25  stripe",
    ]


def test_cells_show_figures_with_four_digits():
    assert [cell_text(value) for value in (None, 0.123456, float("nan"), 3, True, "x")] == ["–", "0.1235", "–", "3", "yes", "x"]
