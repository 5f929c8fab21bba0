"""A service's state as bytes and back: exact, shared things stay shared, no code from outside."""

from dataclasses import fields

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pliant import __version__
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.datasets import open_source
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.errors import StateError
from pliant.messages import codec
from pliant.messages.types import Extrema, Header, MapUpdate
from pliant.state import STATE_VERSION, load_state, save_state

_LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
_TREES = st.recursive(
    _LEAVES,
    lambda inner: (
        st.lists(inner)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text() | st.integers(), inner)
    ),
    max_leaves=30,
)


@given(_TREES)
def test_containers_come_back_equal_and_of_the_same_types(tree: object) -> None:
    again = load_state(save_state(tree))
    assert again == tree
    assert repr(again) == repr(tree)  # tuples are no lists, True is no 1


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12, dtype=np.float32).reshape(3, 4),
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.zeros((0, 7)),
        np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]),
        np.array(3.5),
    ],
)
def test_arrays_keep_type_shape_and_layout(array: np.ndarray) -> None:
    again = load_state(save_state(array))
    assert again.dtype == array.dtype
    assert again.shape == array.shape
    assert again.flags.c_contiguous == array.flags.c_contiguous
    assert again.tobytes() == array.tobytes()
    assert again.flags.writeable


def test_what_is_shared_stays_shared() -> None:
    array = np.zeros(3)
    first, second = load_state(save_state([array, {"same": array}]))
    first[0] = 1.0
    assert second["same"] is first


def test_a_generator_resumes_where_it_was() -> None:
    generator = np.random.default_rng(7)
    generator.random(5)
    again = load_state(save_state(generator))
    assert (again.random(100) == generator.random(100)).all()


def test_what_a_record_has_computed_is_no_state() -> None:
    moved = np.eye(4)
    moved[:3, 3] = 0.1, 0.2, 0.3
    motion = Motion.at(0, 0, np.eye(4)).then(1, 10, moved)
    expected = motion.predictions(20)
    again = load_state(save_state(motion))
    assert vars(again).keys() == {field.name for field in fields(Motion)}
    np.testing.assert_array_equal(again.predictions(20), expected)


def test_foreign_classes_are_refused() -> None:
    class Own:
        pass

    with pytest.raises(StateError, match="cannot be kept"):
        save_state(Own())


def crafted(*nodes: list[object], release: str = __version__) -> bytes:
    """A state of these nodes, with a header that fits."""
    made = CAMERA if tuple(nodes[0][1:3]) == CAMERA_NAME else None
    schema = msgpack.unpackb(save_state(made))[2]
    return msgpack.packb([STATE_VERSION, release, schema, [0], list(nodes)])


CAMERA = PinholeCamera(width=4, height=3, fx=1, fy=1, cx=1, cy=1)
CAMERA_NAME = (PinholeCamera.__module__, "PinholeCamera")


@pytest.mark.parametrize(
    "node",
    [
        ["object", "subprocess", "Popen", {}],
        ["named", "pliant.formats.ply", "write_mesh", []],
        ["named", "pliant.algorithms.camera", "np", []],
        ["object", "pliant.bus.checkpoints", "Checkpoints", {}],
        ["name", "pliant.config", "load_config"],
        ["name", "pliant.algorithms.camera", "dataclass"],
        ["object", *CAMERA_NAME, {"project": None}],
    ],
    ids=lambda node: ".".join(node[1:3]),
)
def test_a_crafted_state_makes_and_calls_nothing_that_is_not_listed(node: list[object]) -> None:
    with pytest.raises(StateError, match=r"none of those|is a method"):
        load_state(crafted(node))


def test_a_crafted_state_cannot_write_a_file(tmp_path) -> None:
    """By a call of a function of ours in the shape of a named tuple."""
    path = tmp_path / "written.png"
    call = ["named", "pliant.pictures.movie", "write_image", [[1], [2]]]
    arguments = [
        ["named", "pliant.config", "Path", [str(path)]],
        ["array", "|u1", [2, 2, 3], "C", True, bytes(12)],
    ]
    with pytest.raises(StateError, match="none of those"):
        load_state(crafted(call, *arguments))
    assert not path.exists()


def test_a_state_of_another_release_or_of_other_records_is_refused_in_one_line() -> None:
    with pytest.raises(StateError, match=f"of pliant 9.9.9, this is {__version__}"):
        load_state(crafted(["list", []], release="9.9.9"))
    content = msgpack.unpackb(save_state(CAMERA))
    content[2] = "01234567"
    with pytest.raises(StateError, match="other fields"):
        load_state(msgpack.packb(content))


@pytest.mark.parametrize("cut", [0, 1, 10, 100])
def test_broken_bytes_are_one_error(cut: int) -> None:
    data = save_state({"a": np.arange(100), "b": CAMERA})
    with pytest.raises(StateError):
        load_state(data[:cut])


def test_a_state_of_another_version_is_refused() -> None:
    with pytest.raises(StateError, match="version"):
        load_state(msgpack.packb([STATE_VERSION + 1, None, []]))


def test_tracker_and_mapper_resume_from_a_saved_state() -> None:
    dataset = open_source("built-in:tiny")
    rectifier = Rectifier(dataset.calibration)
    camera = rectifier.camera
    tracker = ExtremaTracker(camera.width, camera.height, TrackingParameters(), 0)
    mapper = Mapper(camera, MappingParameters(), 0)
    restored: tuple[ExtremaTracker, Mapper] | None = None
    for source in dataset:
        image = rectified(source, rectifier)

        def step(tracker: ExtremaTracker, mapper: Mapper, image=image) -> tuple[bytes, bytes]:
            header = Header(frame=image.frame, stamp_ns=image.stamp_ns, frame_id="world")
            tracks = tracker.track(image.grey, image.stamp_ns)
            delta = mapper.process(
                Frame(image.frame, image.stamp_ns, tracks, image.grey, image.colour)
            )
            return (
                codec.encode(Extrema.of(header, tracks)),
                codec.encode(MapUpdate.of(header, delta)),
            )

        if restored is not None:
            assert step(*restored) == step(tracker, mapper), f"frame {image.frame}"
        else:
            step(tracker, mapper)
        if image.frame in (4, 15, 27):  # waiting for a map, mapping, and once more
            restored = load_state(save_state((tracker, mapper)))
        if image.frame == 32:
            break
    assert restored is not None
    header = Header(frame=0, stamp_ns=0, frame_id="world")
    final, again = (codec.encode(MapUpdate.of(header, m.finish())) for m in (mapper, restored[1]))
    assert final == again
