"""Configuration: strict about names, exact in what it saves."""

from pathlib import Path

import pytest

from pliant.config import Config, config_yaml, describe, load_config, recorded_config
from pliant.errors import ConfigError


def test_defaults_are_valid_and_survive_a_round_trip(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(config_yaml(Config()))
    assert load_config(file) == Config()


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("bus:\n  window: 7\nseed: 3\n")
    config = load_config(file, ["bus.window=9"], seed=5)
    assert (config.bus.window, config.seed) == (9, 5)


def test_what_is_set_of_a_group_leaves_its_other_defaults() -> None:
    """Also where the defaults of a group are not those of its class."""
    defaults = Config()
    config = load_config(None, ["bundle_adjustment.bundle.max_sweeps=7"])
    solver = defaults.bundle_adjustment.bundle.model_copy(update={"max_sweeps": 7})
    assert config.bundle_adjustment.bundle == solver
    told = {key: default for key, default, _ in describe()}
    assert told["bundle_adjustment.bundle.kernel_sigma_px"] == str(solver.kernel_sigma_px)


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("bus.windwo=8", "did you mean bus.window"),
        ("trakcing.x=1", "unknown key trakcing"),
        ("bus.window=many", "bus.window"),
        ("bus.window=0", "bus.window"),
        ("bus.window.deeper=1", "bus.window"),
        ("seed.deeper=1", "seed"),
        ("no-equals-sign", "KEY=VALUE"),
        ("recorder.sync_interval_s=.nan", "sync_interval_s"),
        ("a=[", "not a value"),
    ],
)
def test_what_is_wrong_is_one_line(override: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        load_config(None, [override])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["[1, 2]", "{", "\x00", "5"])
def test_a_file_that_is_no_configuration_is_one_line(tmp_path: Path, text: str) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"config\.yaml") as caught:
        load_config(file)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        load_config(tmp_path / "none.yaml")


def test_every_parameter_has_a_description() -> None:
    unexplained = [key for key, _, meaning in describe() if not meaning]
    assert not unexplained


def test_a_recording_may_name_parameters_that_are_gone() -> None:
    metadata = {"config": {"yaml": "seed: 4\nbus: {window: 7, gone: 1}\nleft: {out: [2]}\n"}}
    config = recorded_config(metadata, ["bus.window=9"])
    assert (config.seed, config.bus.window) == (4, 9)
    with pytest.raises(ConfigError, match=r"unknown key bus\.gone"):
        recorded_config(metadata, ["bus.gone=1"])
