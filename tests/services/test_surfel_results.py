"""Results and exports of a deforming scene, from a recording that no process has written."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pliant
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.surfels.final_surfels import FinalSurfels
from pliant.algorithms.surfels.surface import surface_of
from pliant.bus.replay_bus import ReplayBus
from pliant.config import config_yaml, load_config
from pliant.datasets import open_source
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.export.export import export_result
from pliant.export.kinds import OF_STILL_SCENES
from pliant.formats.npz import NpzWriter
from pliant.formats.tum import read_tum
from pliant.messages import codec, topics
from pliant.messages.types import CONTRADICTED, Surfels
from pliant.recording.reader import Recording
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import (
    DEFORMING_MAP_NAME,
    ONLINE_NAME,
    RECORDING_NAME,
    SURFELS_NAME,
    TRAJECTORY_NAME,
    files_of,
    run_metadata,
)
from pliant.results.surfel_frames import add_final, final_surfels, recorded_surfels
from pliant.results.surfels import surfel_summary
from pliant.results.write import write_results
from pliant_services.nodes import ingest, surfels
from pliant_services.runtime.monitor import SilentMonitor

FRAMES = 5


def record(folder: Path, depth_from: str) -> None:
    """A recording of a short run without images, from depth maps or without any."""
    settings = ["surfels.max_surfels=60", "surfels.camera=moving"]
    config = load_config(None, [*settings, f"surfels.depth_from={depth_from}"])
    source = ReplayBus({})
    depth = "all" if depth_from == "sensor" else "none"
    dataset = open_source(SourceSpec(location=f"built-in:tiny?frames={FRAMES}", depth=depth))
    ingest.run(source, config, SilentMonitor(), dataset, stopping=lambda: False)
    inputs = (topics.STREAM, topics.IMAGE, topics.DEPTH)
    followed = ReplayBus({topic: source.outputs[topic] for topic in inputs})
    surfels.run(followed, config, SilentMonitor())
    with RecordingWriter(folder / RECORDING_NAME, run_metadata(config_yaml(config))) as writer:
        for topic, messages in (
            (topics.STREAM, source.outputs[topics.STREAM]),
            (topics.SURFELS, followed.outputs[topics.SURFELS]),
        ):
            for n, message in enumerate(messages):
                data = codec.encode(message)
                writer.write(topic, data, sequence=n, log_time_ns=n, publish_time_ns=n)


@pytest.mark.parametrize(
    ("depth_from", "verdict", "is_metric"), [("sensor", "good", True), ("flat", "doubtful", False)]
)
def test_depth_that_was_made_up_is_doubtful_and_not_in_metres(
    depth_from: str, verdict: str, is_metric: bool, tmp_path: Path
) -> None:
    record(tmp_path, depth_from)
    report = write_results(tmp_path)
    assert (report["verdict"], report["scale_is_metric"]) == (verdict, is_metric)
    for kind in OF_STILL_SCENES:
        with pytest.raises(ResultError, match=f"^--to {kind} needs the map .* use --to surface"):
            export_result(tmp_path, kind, None, force=False)
    with np.load(export_result(tmp_path, "tracks", None) / "tracks.npz") as tracks:
        assert tracks["unit"].tolist() == ["metre" if is_metric else "arbitrary"]
    head = (tmp_path / "tracks" / "tracks.csv").read_text().partition("\n")[0]
    axes = "x_m,y_m,z_m" if is_metric else "x,y,z"
    assert head == f"frame,seconds,segment,id,{axes},confirmed,zncc,confidence"


def rewrite(recorded: Path, folder: Path, change: Callable[[int, Surfels], Surfels]) -> None:
    """The recording with the surfels of each frame, by its number, changed."""
    reader = Recording(recorded / RECORDING_NAME)
    with RecordingWriter(folder / RECORDING_NAME, reader.metadata()) as writer:
        for topic in (topics.STREAM, topics.SURFELS):
            for n, message in enumerate(reader.decoded(topic)):
                changed = change(n, message) if isinstance(message, Surfels) else message
                data = codec.encode(changed)
                writer.write(topic, data, sequence=n, log_time_ns=n, publish_time_ns=n)


def test_the_trajectory_is_that_of_the_longest_segment(recorded: Path, tmp_path: Path) -> None:
    """Each segment has a world of its own; frames without a pose are in none."""

    def change(number: int, message: Surfels) -> Surfels:
        return replace(message, segment=int(number > 0), lost=number == FRAMES - 1)

    rewrite(recorded, tmp_path, change)
    report = write_results(tmp_path)
    assert [each["frames"] for each in report["segments"]] == [1, FRAMES - 2]
    stamps_ns = [each.stamp_ns for each in recorded_surfels(tmp_path / RECORDING_NAME)]
    poses = read_tum(tmp_path / TRAJECTORY_NAME)
    assert poses.stamps_ns.tolist() == stamps_ns[1:-1]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"confidence": 0.6}, "less than 75% of the surfels in view are probably right"),
        ({"note": f"{CONTRADICTED}: 9 of the 10"}, "the depth map contradicts most surfels"),
        ({"note": "depth/3.png: broken"}, "80% of the depth maps could not be used"),
    ],
)
def test_surfels_that_are_probably_wrong_are_doubtful(
    changed: dict[str, Any], says: str, recorded: Path, tmp_path: Path
) -> None:
    def change(number: int, message: Surfels) -> Surfels:
        if number == 0:
            return message
        share = np.full_like(message.confidence, changed.get("confidence", 1.0))
        return replace(message, confidence=share, note=changed.get("note", ""))

    rewrite(recorded, tmp_path, change)
    report = write_results(tmp_path)
    assert report["verdict"] == "doubtful"
    assert says in report["verdict_reason"]
    summary = "\n".join(surfel_summary(report))
    assert ("unusable depth map" in summary) == ("broken" in changed.get("note", ""))
    assert (CONTRADICTED in summary) == (CONTRADICTED in changed.get("note", ""))


@pytest.mark.parametrize(
    ("refusal", "word"),
    [
        ("", "good"),
        ("too few tracks through several keyframes determine it", "good"),
        ("only 18% of its landmarks are certain", "doubtful"),
    ],
)
def test_cameras_that_the_whole_clip_does_not_determine_are_doubtful(
    refusal: str, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As before a camera that stands still, declared as moving."""
    record(tmp_path, "sensor")
    monkeypatch.setattr("pliant.results.surfels._moves_on_own_map", lambda _: True)
    monkeypatch.setattr("pliant.results.surfels.write_deforming_map", lambda *_: refusal)
    report = write_results(tmp_path)
    assert (report["verdict"], report["deforming_map"]) == (word, refusal)
    assert (word == "good") or refusal in report["verdict_reason"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("deforming")
    record(folder, "sensor")
    return folder


def test_tracks_are_the_tracked_surfels_of_the_recording(recorded: Path, tmp_path: Path) -> None:
    path = export_result(recorded, "tracks", tmp_path / "all")
    frames = list(recorded_surfels(recorded / RECORDING_NAME))
    with np.load(path / "tracks.npz") as found:
        assert found["frames"].tolist() == list(range(FRAMES))
        assert found["stamps_ns"].tolist() == [frame.stamp_ns for frame in frames]
        assert found["positions"].shape == (FRAMES, len(found["ids"]), 3)
        for n, frame in enumerate(frames):
            rows = np.flatnonzero(frame.state == 0)
            tracked = np.isfinite(found["positions"][n, :, 0])
            assert found["ids"][tracked].tolist() == frame.ids[rows].tolist()
            np.testing.assert_array_equal(found["positions"][n, tracked], frame.positions[rows])
            np.testing.assert_array_equal(found["zncc"][n, tracked], frame.zncc[rows])
            np.testing.assert_array_equal(found["confirmed"][n, tracked], frame.confirmed[rows])
            assert (found["confirmed"][n, ~tracked] == -1).all()
            np.testing.assert_array_equal(found["confidence"][n, tracked], frame.confidence[rows])
            np.testing.assert_array_equal(found["T_world_camera"][n], frame.T_world_camera)
        count = np.isfinite(found["positions"][..., 0]).sum()
    lines = (path / "tracks.csv").read_text().splitlines()
    assert len(lines) == 1 + count
    table = np.loadtxt(lines[1:], delimiter=",")
    rows = np.flatnonzero(frames[-1].state == 0)
    last = table[table[:, 0] == FRAMES - 1]
    np.testing.assert_array_equal(last[:, 3], frames[-1].ids[rows])
    np.testing.assert_allclose(last[:, 4:7], frames[-1].positions[rows], rtol=1e-8)
    every = export_result(recorded, "tracks", tmp_path / "every", every=2)
    with np.load(every / "tracks.npz") as found:
        assert found["frames"].tolist() == [0, 2, 4]


def test_strain_is_exported_for_each_triangle_of_the_surface(
    recorded: Path, tmp_path: Path
) -> None:
    path = export_result(recorded, "strain", tmp_path / "strain", every=2)
    assert [each.name for each in path.iterdir()] == ["strain.npz"]  # it has no images
    frames = list(recorded_surfels(recorded / RECORDING_NAME))[::2]
    with np.load(path / "strain.npz") as found:
        strain, triangles, positions = (
            found[name] for name in ("strain", "triangles", "positions")
        )
        assert found["frames"].tolist() == [0, 2, 4]
        assert found["stamps_ns"].tolist() == [frame.stamp_ns for frame in frames]
    assert strain.shape == (3, len(triangles))
    assert positions.shape == (3, triangles.max() + 1, 3)
    for n, frame in enumerate(frames):
        assert np.isfinite(strain[n]).sum() == len(surface_of(frame)[2]) > 40
    stays = np.isfinite(strain).all(axis=0)
    assert (strain[0, stays] == 0.0).all()
    lengths = [
        np.linalg.norm(np.diff(positions[n][triangles[stays]], axis=1), axis=2) for n in (0, 2)
    ]
    assert np.abs(strain[2, stays]).max() < 2.0 * np.abs(lengths[1] / lengths[0] - 1.0).max() + 0.05


def test_python_has_the_surface_of_a_frame(recorded: Path) -> None:
    result = pliant.open(recorded)
    surface = result.surface(3)
    frame = list(result.surfels())[3]
    rows, _, triangles = surface_of(frame)
    np.testing.assert_array_equal(surface.ids, frame.ids[rows])
    np.testing.assert_allclose(surface.positions, frame.positions[rows], rtol=1e-6)
    assert len(surface.triangles) == len(triangles)
    assert (surface.colours == 128).all()
    corners = surface.positions[surface.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((facing * (frame.T_world_camera[:3, 3] - corners[:, 0])).sum(axis=1) > 0.0).all()
    with pytest.raises(ResultError, match="frame 99"):
        result.surface(99)


def test_an_animation_has_the_surfels_of_each_key_frame_in_their_places(
    recorded: Path, tmp_path: Path
) -> None:
    path = export_result(recorded, "animation", tmp_path / "a.glb", every=2)
    again = export_result(recorded, "animation", tmp_path / "b.glb", every=2)
    assert path.read_bytes() == again.read_bytes()
    document, arrays = read_glb(path)
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    rest, targets = primitive["attributes"]["POSITION"], primitive["targets"]
    assert mesh["extras"]["targetNames"] == ["frame 2", "frame 4"]
    assert mesh["weights"] == [0.0, 0.0]
    assert document["nodes"][0]["extras"]["unit"] == "metres"
    frames = list(recorded_surfels(recorded / RECORDING_NAME))
    for n, frame in enumerate(frames[::2]):
        rows, _, triangles = surface_of(frame)
        places = arrays[rest] + (arrays[targets[n - 1]["POSITION"]] if n else 0.0)
        corners = places[arrays[primitive["indices"]].reshape(-1, 3)]
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        shown = corners[np.linalg.norm(facing, axis=1) > 1e-9]
        towards = (facing * (frame.T_world_camera[:3, 3] - corners[:, 0])).sum(axis=1)
        assert (towards > -1e-9).all()
        assert len(shown) == len(triangles) > 40
        expected = frame.positions[rows][triangles]
        order = [np.lexsort(each.mean(axis=1).round(6).T) for each in (shown, expected)]
        np.testing.assert_allclose(
            shown[order[0]].mean(axis=1), expected[order[1]].mean(axis=1), atol=1e-6
        )
        apart = np.linalg.norm(expected.reshape(-1, 1, 3) - shown.reshape(-1, 3), axis=2)
        assert apart.min(axis=0).max() < 1e-6
    (animation,) = document["animations"]
    (sampler,), (channel,) = animation["samplers"], animation["channels"]
    assert channel == {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    seconds = [(frame.stamp_ns - frames[0].stamp_ns) / 1e9 for frame in frames[::2]]
    np.testing.assert_allclose(arrays[sampler["input"]].ravel(), seconds, rtol=1e-6)
    weights = arrays[sampler["output"]].reshape(3, 2)
    np.testing.assert_array_equal(weights, [[0, 0], [1, 0], [0, 1]])


def test_an_animation_of_one_frame_is_one_line(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(ResultError, match=r"two frames with tracked surfels.*smaller --every"):
        export_result(recorded, "animation", tmp_path / "a.glb", every=FRAMES)
    assert not list(tmp_path.iterdir())


def read_glb(path: Path) -> tuple[dict[str, Any], list[Any]]:
    """The document and the arrays of its accessors, whose rules are asserted."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind, size % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    document, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert struct.unpack_from("<I4s", data, 20 + size) == (len(body), b"BIN\0")
    assert document["buffers"] == [{"byteLength": len(body)}]
    arrays: list[Any] = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        dtype = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        rows = np.frombuffer(part, dtype).reshape(accessor["count"], columns)
        if "min" in accessor:
            assert accessor["min"] == rows.min(axis=0).tolist()
            assert accessor["max"] == rows.max(axis=0).tolist()
        arrays.append(rows)
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            count = len(arrays[primitive["attributes"]["POSITION"]])
            for each in (primitive["attributes"], *primitive.get("targets", [])):
                assert "min" in document["accessors"][each["POSITION"]]
                assert all(len(arrays[index]) == count for index in each.values())
            assert arrays[primitive["indices"]].max() < count
    for animation in document.get("animations", []):
        for sampler in animation["samplers"]:
            assert "min" in document["accessors"][sampler["input"]]
    return document, arrays


def final_of(recording: Path) -> FinalSurfels:
    """Another camera in all frames but the last, and depths that are too small by a tenth."""
    frames = list(recorded_surfels(recording))[:-1]
    T = np.array([each.T_world_camera for each in frames])
    T[:, :3, 3] += (0.1, 0.0, 0.0)
    ids = frames[0].ids
    return FinalSurfels(
        frames=np.array([each.frame for each in frames]),
        T_world_camera=T,
        segments=np.full(len(ids), frames[0].segment),
        ids=ids,
        factor_stamps_ns=np.full(len(ids), frames[0].stamp_ns),
        factors=np.full(len(ids), 1.1, np.float32),
    )


def written_map(recording: Path, path: Path) -> None:
    with NpzWriter(path) as npz:
        add_final(npz, final_of(recording))


def test_all_readers_have_the_surfels_of_the_final_map(tmp_path: Path) -> None:
    record(tmp_path, "sensor")
    recording = tmp_path / RECORDING_NAME
    written_map(recording, tmp_path / DEFORMING_MAP_NAME)
    online, final = (list(read(recording)) for read in (recorded_surfels, final_surfels))
    for before, after in zip(online[:-1], final[:-1], strict=True):
        moved = after.T_world_camera[:3, 3] - before.T_world_camera[:3, 3]
        np.testing.assert_allclose(moved, [0.1, 0.0, 0.0], atol=1e-12)
        depths = [transform(inverse(s.T_world_camera), s.positions) for s in (before, after)]
        np.testing.assert_allclose(depths[1], 1.1 * depths[0], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(final[-1].positions, online[-1].positions)
    result = pliant.open(tmp_path)
    for here, there in zip(result.surfels(), final, strict=True):
        np.testing.assert_array_equal(here.positions, there.positions)
    rows, _, _ = surface_of(final[1])
    np.testing.assert_array_equal(
        result.surface(1).positions, final[1].positions[rows].astype(np.float32)
    )
    poses = [each.T_world_camera for each in final]
    np.testing.assert_array_equal(result.trajectory.T_world_camera, poses)
    tracks = export_result(tmp_path, "tracks", tmp_path / "tracks")
    with np.load(tracks / "tracks.npz") as found:
        np.testing.assert_array_equal(found["T_world_camera"], poses)
        known = np.isfinite(found["positions"][1, :, 0])
        tracked = final[1].state == 0
        np.testing.assert_array_equal(found["positions"][1, known], final[1].positions[tracked])
    places = {"final": tmp_path, "online": tmp_path / "alone"}
    places["online"].mkdir()
    (places["online"] / RECORDING_NAME).hardlink_to(recording)
    surfaces = [export_result(at, "surface", tmp_path / name) for name, at in places.items()]
    same = [
        (surfaces[0] / name).read_bytes() == (surfaces[1] / name).read_bytes()
        for name in (f"{frame:06d}.ply" for frame in range(FRAMES))
    ]
    assert same == [False] * (FRAMES - 1) + [True]
    animated = [
        export_result(at, "animation", tmp_path / f"{name}.glb").read_bytes()
        for name, at in places.items()
    ]
    assert animated[0] != animated[1]


def test_files_have_the_final_surfels_and_the_online_trajectory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(tmp_path, "sensor")
    recording = tmp_path / RECORDING_NAME
    write_results(tmp_path)
    as_before = (tmp_path / SURFELS_NAME).read_bytes()
    monkeypatch.setattr("pliant.results.surfels._moves_on_own_map", lambda _: True)
    assert write_results(tmp_path)["deforming_map"] == "the run has no map"
    assert not (tmp_path / ONLINE_NAME).exists()
    assert (tmp_path / SURFELS_NAME).read_bytes() == as_before

    def made(path: Path, *_: Any) -> str:
        written_map(recording, path)
        return ""

    monkeypatch.setattr("pliant.results.surfels.write_deforming_map", made)
    report = write_results(recording.parent)
    assert report["deforming_map"] == ""
    assert {ONLINE_NAME, DEFORMING_MAP_NAME} <= set(files_of(recording.parent, report))
    frames = {"online": list(recorded_surfels(recording)), "": list(final_surfels(recording))}
    for name, path in (("online", ONLINE_NAME), ("", TRAJECTORY_NAME)):
        poses = read_tum(recording.parent / path).T_world_camera
        np.testing.assert_allclose(poses, [f.T_world_camera for f in frames[name]], atol=1e-6)
    with np.load(recording.parent / SURFELS_NAME) as found:
        positions = np.concatenate([frame.positions for frame in frames[""]])
        np.testing.assert_array_equal(found["positions"], positions)
    page = (recording.parent / "report.html").read_text()
    assert "Cameras and surfels are those of the map of the whole run" in page


def test_a_file_that_is_no_map_is_named_and_an_older_one_changes_nothing(tmp_path: Path) -> None:
    record(tmp_path, "sensor")
    file, recording = tmp_path / DEFORMING_MAP_NAME, tmp_path / RECORDING_NAME
    np.savez(file, frames=np.arange(3))
    for online, final in zip(recorded_surfels(recording), final_surfels(recording), strict=True):
        np.testing.assert_array_equal(final.positions, online.positions)
    file.write_bytes(b"no zip")
    with pytest.raises(ResultError, match="no valid map: remove the file"):
        final_surfels(recording)
