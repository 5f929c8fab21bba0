"""Images over a link: readers work on what the source gave, or on the JPEG that is recorded."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pliant.algorithms.image.masks import packed, unpacked
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.base import Dataset, SourceFrame, encoding_of
from pliant.datasets.calibration import calibration_yaml
from pliant.datasets.jpeg import jpeg_size
from pliant.datasets.rectifier import Rectifier
from pliant.errors import MessageError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import Header, Image, SourceImage
from pliant_services.nodes import ingest
from pliant_services.runtime.link_images import clearance, receive_images, whole
from pliant_services.runtime.monitor import SilentMonitor

FRAMES = 3
SOURCE = f"built-in:tiny?frames={FRAMES}&distortion=-0.2,0.1,0,0"


class _Jpegs:
    """The built-in frames, as a camera that gives JPEGs has them; the second one is broken."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self.name, self.calibration = dataset.name, dataset.calibration
        self.is_live, self.frame_count, self.ground_truth_path = False, FRAMES, None

    def __iter__(self):
        for frame in self._dataset:
            data = cv2.imencode(".jpg", cv2.imdecode(np.frombuffer(frame.data, np.uint8), 1))[1]
            cut = data.tobytes()[: 400 if frame.index == 1 else None]
            yield SourceFrame(
                index=frame.index, stamp_ns=frame.stamp_ns, encoding=encoding_of(cut), data=cut
            )


class _Bonnet(_Jpegs):
    """The frames with a mask over their lower third."""

    def __iter__(self):
        used = np.ones((240, 320), np.bool_)
        used[160:] = False
        for frame in self._dataset:
            yield replace(frame, mask=packed(used))


def ingested(how: str, *, jpegs: bool = False, masked: bool = False) -> dict[Topic, list[Header]]:
    dataset: Dataset = open_source(SOURCE)
    bus = ReplayBus({})
    config = load_config(overrides=[f"bus.link_images={how}", "bus.jpeg_quality=70"])
    source = _Jpegs(dataset) if jpegs else _Bonnet(dataset) if masked else dataset
    ingest.run(bus, config, SilentMonitor(), source, stopping=lambda: False)
    return bus.outputs


def read(sent: dict[Topic, list[Header]]) -> list[Image]:
    return list(receive_images(ReplayBus({topics.IMAGE: sent[topics.IMAGE]})))


def wire(images: list[Image]) -> list[bytes]:
    return [codec.encode(image) for image in images]


@pytest.mark.slow
@pytest.mark.parametrize("jpegs", [False, True])
def test_lossless_is_lossless_also_of_jpegs_which_cross_themselves(jpegs: bool) -> None:
    raw, lossless = ingested("raw", jpegs=jpegs), ingested("lossless", jpegs=jpegs)
    assert wire(read(lossless)) == wire([whole(image) for image in read(raw)])
    assert lossless[topics.SOURCE] == raw[topics.SOURCE]
    crossing = [image.jpeg for image in lossless[topics.IMAGE] if isinstance(image, Image)]
    sources = [source.data for source in raw[topics.SOURCE] if isinstance(source, SourceImage)]
    assert crossing == ([sources[0], b"", sources[2]] if jpegs else [b""] * FRAMES)


@pytest.mark.slow
def test_what_is_worked_on_is_the_jpeg_that_is_recorded() -> None:
    sent = ingested("jpeg")
    for source, image in zip(sent[topics.SOURCE], sent[topics.IMAGE], strict=True):
        assert isinstance(source, SourceImage)
        assert isinstance(image, Image)
        assert source.made_from == "png, quality 70"
        assert source.encoding == "jpeg"
        assert image.jpeg == source.data
        assert image.grey.size == 0
    again = ingest.run  # a run from the recorded frames, without a link
    bus = ReplayBus({})
    dataset = _Recorded(sent[topics.SOURCE], open_source(SOURCE))
    again(bus, load_config(), SilentMonitor(), dataset, stopping=lambda: False)
    assert wire(read(bus.outputs)) == wire(read(sent))
    assert wire(read(sent)) != wire(read(ingested("raw")))


class _Recorded(_Jpegs):
    def __init__(self, sources: list[Header], dataset: Dataset) -> None:
        super().__init__(dataset)
        self._sources = sources

    def __iter__(self):
        for source in self._sources:
            assert isinstance(source, SourceImage)
            yield SourceFrame(
                index=source.frame, stamp_ns=source.stamp_ns,
                encoding=source.encoding, data=source.data,
            )  # fmt: skip


def test_on_one_machine_grey_crosses_and_the_colours_of_a_jpeg_stay_in_it() -> None:
    frames = list(_Jpegs(open_source(SOURCE + "&colour=true")))
    bus = ReplayBus({})
    source = _Jpegs(open_source(SOURCE + "&colour=true"))
    ingest.run(bus, load_config(), SilentMonitor(), source, stopping=lambda: False)
    sent = [image for image in bus.outputs[topics.IMAGE] if isinstance(image, Image)]
    assert [image.colour.size for image in sent] == [0, 0, 0]
    assert [image.jpeg for image in sent] == [frames[0].data, b"", frames[2].data]
    rectifier = Rectifier(source.calibration)
    for image, frame in zip(sent[::2], frames[::2], strict=True):
        grey, colour = rectifier.rectify(frame)
        assert colour is not None
        np.testing.assert_array_equal(image.grey, grey)
        np.testing.assert_array_equal(whole(image).grey, grey)
        np.testing.assert_array_equal(whole(image).colour, colour)


@pytest.mark.parametrize("how", ["raw", "lossless", "jpeg"])
def test_a_mask_crosses_with_its_image(how: str) -> None:
    sent = ingested(how, masked=True)
    clear = [clearance(image) for image in read(sent)]
    for source, found in zip(sent[topics.SOURCE], clear, strict=True):
        assert isinstance(source, SourceImage)
        assert found is not None
        # As rectified: what was straight in the source bends.
        assert (found[-1] == 0.0).all()
        assert 0.6 < (found > 0.0).mean() < 0.72
        assert unpacked(source.mask).mean() == pytest.approx(2 / 3)
    (first, *_), other = read(sent), packed(np.eye(3) > 0)
    for wrong, words in ((other, "another size"), (b"noise", "no image that can be read")):
        with pytest.raises(MessageError, match=f"camera/image: frame 0: .*{words}"):
            clearance(replace(first, mask=wrong))
    assert clearance(replace(first, mask=b"")) is None


def test_a_jpeg_that_is_none_of_the_camera_s_is_refused_before_it_is_decoded() -> None:
    sent = ingested("jpeg")[topics.IMAGE][0]
    assert isinstance(sent, Image)
    large = cv2.imencode(".jpg", np.zeros((999, 7), np.uint8))[1].tobytes()
    assert jpeg_size(large) == (7, 999)
    for jpeg in (large, b"\xff\xd8\xff", b"noise", sent.jpeg[:300]):
        with pytest.raises(MessageError, match="frame 0"):
            whole(replace(sent, jpeg=jpeg))
    with pytest.raises(MessageError, match="frame 0"):
        whole(replace(sent, calibration="model: none"))


def test_the_size_is_found_behind_other_segments() -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    comment = b"\xff\xfe\x00\x06text"
    assert jpeg_size(jpeg[:2] + comment + b"\xff" + jpeg[2:]) == (64, 48)
    for length in range(2, 20):
        assert jpeg_size(jpeg[:length]) is None


def test_the_calibration_that_crosses_is_the_source_s() -> None:
    sent = ingested("jpeg")[topics.IMAGE][0]
    assert isinstance(sent, Image)
    assert sent.calibration == calibration_yaml(open_source(SOURCE).calibration)
