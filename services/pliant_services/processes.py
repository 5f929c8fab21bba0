"""The one list of processes: what each reads and publishes.  Launcher and deployment follow it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pliant.messages import topics
from pliant.messages.topics import Topic

if TYPE_CHECKING:
    from pliant.config import Config
    from pliant.datasets.source_spec import SourceSpec


@dataclass(frozen=True)
class Process:
    """A service: its module has ``run(bus, ...)``.

    optional: topics that it reads besides where a service of the fleet publishes them.
    observer: it reads every logged topic of the others, and has no readers.
    niceness: how much it gives way where processors are few; others do not wait for what it makes.
    finishing: what it does when the last frame is done, for people; "" where that is nothing.
    may_lag: it may be further behind than others with frames that bundle adjustment passes over.
    kernels: its module has ``warm_up()``, which calls each kernel once, on a small input of the
    types that it meets: the first call compiles it, or loads it, so the first frame is no slower.
    """

    name: str
    module: str
    inputs: tuple[Topic, ...] = ()
    outputs: tuple[Topic, ...] = field(default=())
    optional: tuple[Topic, ...] = ()
    observer: bool = False
    niceness: int = 0
    finishing: str = ""
    may_lag: bool = False
    kernels: bool = False


PROCESSES: tuple[Process, ...] = (
    Process(
        "ingest",
        "pliant_services.nodes.ingest",
        outputs=(
            topics.STREAM,
            topics.CLIP,
            topics.IMU,
            topics.GPS,
            topics.MAP_KNOWN,
            topics.SOURCE,
            topics.IMAGE,
            topics.DEPTH,
        ),
    ),
    Process(
        "tracking",
        "pliant_services.nodes.tracking",
        inputs=(topics.STREAM, topics.IMAGE),
        outputs=(topics.EXTREMA,),
        kernels=True,
    ),
    Process(
        "bundle_adjustment",
        "pliant_services.nodes.bundle_adjustment",
        finishing="adjusting the whole map",
        inputs=(topics.STREAM, topics.IMAGE, topics.EXTREMA),
        optional=(topics.MAP_KNOWN, topics.IMU),
        outputs=(
            topics.MAP_UPDATE,
            topics.MAP_FINAL,
            topics.KEYFRAME,
            topics.KEYFRAME_FINAL,
            topics.MAP_KEPT,
        ),
        may_lag=True,
        kernels=True,
    ),
    Process(
        "meshing",
        "pliant_services.nodes.meshing",
        finishing="fusing the final mesh",
        inputs=(
            topics.STREAM,
            topics.MAP_UPDATE,
            topics.KEYFRAME,
            topics.MAP_FINAL,
            topics.KEYFRAME_FINAL,
        ),
        outputs=(topics.MESH_BLOCKS, topics.MESH_FINAL),
        niceness=5,
        kernels=True,
    ),
    Process(
        "deformable_mapping",
        "pliant_services.nodes.deformable_mapping",
        inputs=(topics.STREAM, topics.EXTREMA, topics.MAP_UPDATE),
        outputs=(topics.MAP_DEFORMING,),
        may_lag=True,
        kernels=True,
    ),
    Process(
        "surfels",
        "pliant_services.nodes.surfels",
        inputs=(topics.STREAM, topics.IMAGE, topics.DEPTH),
        optional=(topics.EXTREMA, topics.MAP_UPDATE, topics.KEYFRAME, topics.MAP_DEFORMING),
        outputs=(topics.SURFELS,),
        may_lag=True,  # with a map: it reads an update for every frame
        kernels=True,
    ),
    # Senders keep what it has not taken, some seconds' worth, and wait for it beyond.
    Process("recorder", "pliant_services.nodes.recorder", observer=True, niceness=5),
)

BY_NAME = {process.name: process for process in PROCESSES}
COMPILED = tuple(process.name for process in PROCESSES if process.kernels)


def in_order_of_start(services: Sequence[str]) -> list[str]:
    """Observers first, which load little, then in the order of the frames: each starts while its
    readers are loaded."""
    return sorted(services, key=lambda name: not BY_NAME[name].observer)


def with_depth(source: "SourceSpec", fleet: Sequence[str], config: "Config") -> "SourceSpec":
    """A source with the depth maps that a service of the fleet reads."""
    reads = config.surfels.depth_from == "sensor" and any(
        topics.DEPTH in BY_NAME[name].inputs for name in fleet
    )
    return source.model_copy(update={"depth": config.ingest.depth if reads else "none"})


def deformable_fleet(config: "Config") -> str:
    """The profile that makes what surfels are configured to use."""
    return "deformable-map" if config.surfels.depth_from == "map" else "deformable"


def inputs_of(name: str, fleet: Sequence[str], *, images: bool = True) -> dict[Topic, str]:
    """The topics that a service reads in a fleet, each with the service that publishes it.

    images: whether observers read the source's images, too.
    """
    process = BY_NAME[name]
    senders = {t: sender for sender in fleet for t in outputs_of(sender)}
    if process.observer:
        left_out = () if images else (topics.CLIP, topics.SOURCE, topics.DEPTH)
        return {t: s for t, s in senders.items() if t.logged and t not in left_out}
    optional = (topic for topic in process.optional if topic in senders)
    return {topic: senders[topic] for topic in (*process.inputs, *optional)}


def outputs_of(name: str) -> tuple[Topic, ...]:
    """The topics that a service publishes: its own, and its status."""
    process = BY_NAME[name]
    return () if process.observer else (*process.outputs, topics.status(name))


def readers_of(
    name: str, fleet: Sequence[str], *, images: bool = True
) -> Mapping[Topic, tuple[str, ...]]:
    """The services that must read every message, for each topic that a service publishes."""
    return {
        topic: tuple(reader for reader in fleet if topic in inputs_of(reader, fleet, images=images))
        for topic in outputs_of(name)
    }
