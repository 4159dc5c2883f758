"""The parameters of all stages: one file for nodes and command line, generated, checked as a whole."""

from __future__ import annotations

import pytest
import yaml

from vli_bringup.graph import NODE_ONLY
from vli_bringup.settings import NODES, Settings, load_settings, to_yaml
from vli_common.config import parameters
from vli_common.errors import ConfigError
from vli_common.node.parameters import NodeConfig
from vli_driver.nodes import demux_node
from vli_driver.player import PlaybackConfig
from vli_frontend.nodes import frontend_node
from vli_mapping.nodes import mapping_node


def write(path, text):
    path.write_text(text)
    return path


def test_the_file_in_config_is_the_one_that_make_config_writes(repository):
    assert (repository / "config" / "vli.yaml").read_text() == to_yaml(Settings())


def test_the_file_holds_every_parameter_and_reads_back_as_the_defaults(tmp_path):
    text = to_yaml(Settings())
    document = yaml.safe_load(text)
    assert set(document) == {f"/**/{node}" for node in NODES}
    assert all(spec.name.rsplit(".", 1)[-1] + ":" in text for spec in parameters(Settings))
    assert load_settings(write(tmp_path / "vli.yaml", text)) == Settings()


def test_settings_as_used_read_back_the_same(tmp_path):
    settings = load_settings(assignments=["backend.window_keyframes=9", "demux.min_ratio=1e1", "driver.image_topic=/front"])
    assert load_settings(write(tmp_path / "config.yaml", to_yaml(settings))) == settings
    assert (settings.backend.window_keyframes, settings.demux.min_ratio, settings.driver.image_topic) == (9, 10.0, "/front")


def test_a_file_may_hold_only_what_it_changes_nested_or_dotted(tmp_path):
    nested = "/**/demux_node:\n  ros__parameters:\n    demux:\n      min_ratio: 2.5\n"
    dotted = "demux_node:\n  ros__parameters:\n    demux.min_ratio: 25e-1\n"
    for text in (nested, dotted):
        settings = load_settings(write(tmp_path / "some.yaml", text))
        assert settings.demux.min_ratio == 2.5
        assert settings.backend == Settings().backend


def test_an_assignment_outranks_the_file(tmp_path):
    path = write(tmp_path / "some.yaml", "/**/backend_node:\n  ros__parameters:\n    window_keyframes: 6\n")
    assert load_settings(path, ["backend.window_keyframes=7"]).backend.window_keyframes == 7


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: [", "is not YAML"),
        ("5", "holds '5', expected sections like '/**/frontend_node:'"),
        ("/**/backnd_node:\n  ros__parameters: {}\n", r"unknown section '/**/backnd_node', did you mean '/**/backend_node'?"),
        ("/**/backend_node:\n  window_keyframes: 6\n", "expected one key 'ros__parameters:'"),
        ("/**/backend_node:\n  ros__parameters:\n    window_keyframe: 6\n", "did you mean 'backend.window_keyframes'?"),
        (
            "/**/backend_node:\n  ros__parameters:\n    window_keyframes: 1000\n",
            "'backend.window_keyframes' is '1000', expected 4 to",
        ),
    ],
)
def test_a_broken_file_is_one_error_that_names_the_place(tmp_path, text, said):
    with pytest.raises(ConfigError) as error:
        load_settings(write(tmp_path / "broken.yaml", text))
    assert said in str(error.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"parameter file '.*none.yaml' cannot be read"):
        load_settings(tmp_path / "none.yaml")


def test_all_wrong_assignments_are_said_at_once():
    with pytest.raises(ConfigError) as error:
        load_settings(assignments=["backend.window_keyframes", "backend.tilt=1", "demux.min_ratio=much"])
    assert len(error.value.problems) == 3


@pytest.mark.parametrize("value", ["[1", "*x", "!!python/object:os.system 1", "1" * 400, "", "{a: 1}"])
def test_a_value_that_is_none_is_one_error(value):
    with pytest.raises(ConfigError, match=r"backend.window_keyframes"):
        load_settings(assignments=[f"backend.window_keyframes={value}", "backend.window_keyframes=1"])
    with pytest.raises(ConfigError, match=r"demux.min_ratio"):
        load_settings(assignments=[f"demux.min_ratio={value}"])


def test_what_concerns_nodes_only_may_stand_in_the_file_and_is_passed_over(tmp_path):
    text = "/**/demux_node: {ros__parameters: {image_topic: /front, mode: vi, demux.min_ratio: 2.5}}\n"
    text += "/**/driver_node: {ros__parameters: {image_topic: /front, rate: 0.5}}\n"
    settings = load_settings(write(tmp_path / "vli.yaml", text))
    assert (settings.demux.min_ratio, settings.driver.image_topic) == (2.5, "/front")


def test_the_parameters_of_nodes_only_are_those_that_the_nodes_declare():
    configs = (NodeConfig, PlaybackConfig, demux_node.InputTopics, frontend_node.InputTopics, mapping_node.StoreConfig)
    assert {spec.name for config in configs for spec in parameters(config)} == NODE_ONLY
