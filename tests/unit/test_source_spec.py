"""The description of a source, between processes."""

from pathlib import Path

import pytest

from pliant.datasets.source_spec import SourceSpec
from pliant.errors import CalibrationError, DatasetError


def test_it_travels_as_json() -> None:
    plain = SourceSpec(location="camera:0")
    full = SourceSpec(
        location="odd \udcff name.mp4",  # a file name that is not UTF-8
        fov_deg=70.0,
        topic="/camera",
        mask=Path("mask \udcfe.png"),
        depth="first",
    )
    for spec in (plain, full, SourceSpec(location="a.mp4", calibration=Path("calib.yaml"))):
        assert SourceSpec.parse(spec.to_json()) == spec


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "not JSON"),
        ("{}", "location: Field required"),
        ('{"location": "a.mp4", "lens": "wide"}', "lens: Extra inputs"),
        ('{"location": "a.mp4", "fov_deg": "wide"}', "fov_deg: Input should be a valid number"),
    ],
)
def test_what_is_none_is_refused_in_one_line(text: str, says: str) -> None:
    with pytest.raises(DatasetError, match=says) as raised:
        SourceSpec.parse(text)
    assert "\n" not in str(raised.value)


def test_a_calibration_and_a_field_of_view_exclude_each_other() -> None:
    with pytest.raises(CalibrationError, match="pass only one"):
        SourceSpec(location="a.mp4", calibration=Path("calib.yaml"), fov_deg=60.0)
