"""What the results of a deforming scene say follows from the configuration that was recorded."""

from pathlib import Path

import pytest

from pliant.bus.replay_bus import ReplayBus
from pliant.config import config_yaml, load_config
from pliant.datasets import open_source
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.export.export import export_result
from pliant.export.kinds import OF_STILL_SCENES
from pliant.messages import codec, topics
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import RECORDING_NAME, run_metadata
from pliant.results.write import write_results
from pliant_services.nodes import ingest, surfels
from pliant_services.runtime.monitor import SilentMonitor

FRAMES = 5


@pytest.mark.parametrize(
    ("depth_from", "verdict", "is_metric"), [("sensor", "good", True), ("flat", "doubtful", False)]
)
def test_depth_that_was_made_up_is_doubtful_and_not_in_metres(
    depth_from: str, verdict: str, is_metric: bool, tmp_path: Path
) -> None:
    settings = ["surfels.max_surfels=60", "surfels.camera=moving"]
    config = load_config(None, [*settings, f"surfels.depth_from={depth_from}"])
    source = ReplayBus({})
    depth = "all" if depth_from == "sensor" else "none"
    dataset = open_source(SourceSpec(location=f"built-in:tiny?frames={FRAMES}", depth=depth))
    ingest.run(source, config, SilentMonitor(), dataset, stopping=lambda: False)
    inputs = (topics.STREAM, topics.IMAGE, topics.DEPTH)
    followed = ReplayBus({topic: source.outputs[topic] for topic in inputs})
    surfels.run(followed, config, SilentMonitor())
    with RecordingWriter(tmp_path / RECORDING_NAME, run_metadata(config_yaml(config))) as writer:
        for topic, messages in (
            (topics.STREAM, source.outputs[topics.STREAM]),
            (topics.SURFELS, followed.outputs[topics.SURFELS]),
        ):
            for n, message in enumerate(messages):
                data = codec.encode(message)
                writer.write(topic, data, sequence=n, log_time_ns=n, publish_time_ns=n)
    report = write_results(tmp_path)
    assert (report["verdict"], report["scale_is_metric"]) == (verdict, is_metric)
    for kind in OF_STILL_SCENES:
        with pytest.raises(ResultError, match=f"^--to {kind} needs the map .* use --to surface"):
            export_result(tmp_path, kind, None, force=False)
