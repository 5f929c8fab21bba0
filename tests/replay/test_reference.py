"""The replay of the reference recording, and recordings of every version that was released."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import reference

from pliant import arithmetic
from pliant.messages import codec, topics
from pliant.recording.reader import Recording
from pliant.recording.summary import summarise

DATA = Path(__file__).parents[1] / "data"
REFERENCE = DATA / "reference"


def test_the_services_make_of_the_reference_what_they_made() -> None:
    found = reference.check(REFERENCE)
    assert not found, (
        "; ".join(found) + "\nif this is meant: scripts/bench reference --refresh, and say why"
    )


def test_the_fingerprint_has_whose_code_and_what_it_computes_for() -> None:
    found = reference.fingerprint()
    assert found.items() >= arithmetic.in_force().items()
    assert found["numpy version"] == np.__version__


def test_the_docs_have_the_fingerprints() -> None:
    page = (DATA.parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert reference.table(REFERENCE) in page, "scripts/bench reference --refresh writes it"


def test_other_bytes_count_on_the_same_machine_alone_and_other_counts_everywhere() -> None:
    expected = json.loads((REFERENCE / reference.EXPECTED).read_text())
    assert list(reference.differences(expected, expected)) == []
    found = copy.deepcopy(expected)
    found["topics"]["tracks/extrema"]["sha256"] = "0"
    assert "tracks/extrema: other bytes" in next(reference.differences(expected, found))
    found["fingerprint"]["cpu"] = "another"
    assert list(reference.differences(expected, found)) == []
    found["topics"]["tracks/extrema"]["median"] *= 1.06
    assert "median" in next(reference.differences(expected, found))
    found["topics"]["tracks/extrema"]["messages"] -= 1
    assert "messages, was 8" in next(reference.differences(expected, found))
    del found["topics"]["map/update"]
    assert "map/update: gone" in list(reference.differences(expected, found))


def recordings() -> list[Path]:
    return sorted((DATA / "recordings").glob("*.mcap"))


def test_there_is_a_recording_of_this_version() -> None:
    assert f"schema_{codec.SCHEMA_VERSION}.mcap" in [path.name for path in recordings()]


@pytest.mark.parametrize("path", recordings(), ids=lambda path: path.stem)
def test_recordings_of_every_version_are_read(path: Path) -> None:
    """Made by ``scripts/bench reference --refresh`` when the version is new; never made again."""
    summary = summarise(path)
    assert summary.complete
    assert not summary.damage
    for topic in (
        topics.STREAM,
        topics.SOURCE,
        topics.EXTREMA,
        topics.MAP_UPDATE,
        topics.MAP_FINAL,
    ):
        messages = list(Recording(path).decoded(topic))
        assert len(messages) == summary.topics[topic.key].messages > 0, topic.key
    assert summary.metadata["config"]["yaml"]
    assert "calibration.yaml" in Recording(path).attachments()
