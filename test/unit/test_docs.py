"""The pages under docs/ against what they describe: topics, parameters, links."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from vli_bringup.cli import make_parser
from vli_bringup.graph import NODE_ONLY
from vli_bringup.settings import Settings
from vli_common.config import parameters
from vli_common.topics import TOPICS, Topic

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = sorted(page for pattern in ("*.md", "docs/*.md", "bags/*.md") for page in REPOSITORY.glob(pattern))
CODE = re.compile(r"`([^`]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
STAGE_PARAMETER = re.compile(r"(?:driver|demux|stripe|frontend|backend|mapping)(?:\.\w+)+")
SHORT_NAMES = {"driver_node": "driver", "demux_node": "demux", "frontend_node": "front end", "backend_node": "back end"}


def rows(page: str, columns: int) -> dict[str, list[str]]:
    """Return name → cells of every table of a page with so many columns; a first cell may hold several names."""
    found = {}
    for line in (REPOSITORY / "docs" / page).read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and len(cells) == columns:
            found |= dict.fromkeys(CODE.findall(cells[0]), cells)
    return found


def name_of(topic: Topic) -> str:
    return topic.type.split("/")[-1] if topic.type.endswith("PointCloud2") else topic.type.replace("/msg/", "/")


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_every_topic_stands_in_docs_topics_with_type_quality_and_ends(topic: Topic) -> None:
    _, kind, quality, ends, _ = rows("topics.md", 5)[topic.name]
    sources, targets = ends.split(" → ")
    assert kind == name_of(topic)
    assert quality == f"R {'TL ' if topic.transient_local else ''}{topic.depth}"
    for names, text in ((topic.sources, sources), (topic.targets, targets)):
        everyone = len(names) == 5
        assert everyone or text == ", ".join(SHORT_NAMES.get(name, name.removesuffix("_node")) for name in names)
        assert not everyone or "node" in text


@pytest.mark.parametrize("topic", [topic for topic in TOPICS if topic.fields], ids=lambda topic: topic.name)
def test_every_field_of_a_cloud_stands_in_docs_topics(topic: Topic) -> None:
    cells = rows("topics.md", 3)[topic.name]
    assert set(topic.fields.names) <= set(CODE.findall(cells[2]))


def test_docs_topics_names_no_topic_that_is_not_there() -> None:
    assert set(rows("topics.md", 5)) == {topic.name for topic in TOPICS}


def test_every_parameter_of_nodes_alone_stands_in_docs_topics() -> None:
    assert set(CODE.findall((REPOSITORY / "docs/topics.md").read_text())) >= NODE_ONLY


@pytest.mark.parametrize("package", ["vli_common", "vli_driver", "vli_frontend", "vli_backend", "vli_mapping"])
def test_every_module_stands_in_docs_architecture(package: str) -> None:
    modules = {path.stem for path in (REPOSITORY / "src" / package / package).glob("*.py")} - {"__init__"}
    named = set(CODE.findall(rows("architecture.md", 3)[package][1]))
    assert {name for name in named if not name.endswith("/")} == modules


@pytest.mark.parametrize("page", ["tuning.md", "conventions.md", "evaluation.md", "topics.md"])
def test_parameters_named_in_the_docs_exist(page: str) -> None:
    known = {spec.name for spec in parameters(Settings)}
    named = {text for text in CODE.findall((REPOSITORY / "docs" / page).read_text()) if STAGE_PARAMETER.fullmatch(text)}
    assert named <= known
    assert page != "tuning.md" or len(named) > 20


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_relative_links_lead_somewhere(page: Path) -> None:
    targets = [target.partition("#")[0] for target in LINK.findall(page.read_text()) if "://" not in target]
    assert [target for target in targets if target and not (page.parent / target).exists()] == []


def commands(page: Path) -> list[str]:
    """Return every ``vli`` command line in the shell blocks of a page."""
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
    lines = [line.partition(" #")[0].strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if line.startswith("vli ")]


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.name)
def test_every_command_of_a_page_has_the_arguments_that_it_takes(page: Path) -> None:
    for line in commands(page):
        arguments = shlex.split(line)[1:]
        try:
            _, unknown = make_parser(arguments[0]).parse_known_args(arguments)
        except SystemExit:
            pytest.fail(f"'{line}' is refused")
        assert unknown == [], line
