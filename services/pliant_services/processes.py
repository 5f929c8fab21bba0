"""The one list of processes: what each reads and publishes.  Launcher and deployment follow it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pliant.messages import topics
from pliant.messages.topics import Topic


@dataclass(frozen=True)
class Process:
    """A service: its module has ``run(bus, ...)``.

    observer: it reads every logged topic of the others, and nobody reads it.
    niceness: how much it gives way where processors are few; others do not wait for what it makes.
    """

    name: str
    module: str
    inputs: tuple[Topic, ...] = ()
    outputs: tuple[Topic, ...] = field(default=())
    observer: bool = False
    niceness: int = 0


PROCESSES: tuple[Process, ...] = (
    Process(
        "ingest",
        "pliant_services.ingest",
        outputs=(topics.STREAM, topics.SOURCE, topics.IMAGE, topics.DEPTH),
    ),
    Process(
        "tracking",
        "pliant_services.tracking",
        inputs=(topics.STREAM, topics.IMAGE),
        outputs=(topics.EXTREMA,),
    ),
    Process(
        "bundle_adjustment",
        "pliant_services.bundle_adjustment",
        inputs=(topics.STREAM, topics.IMAGE, topics.EXTREMA),
        outputs=(topics.MAP_UPDATE, topics.MAP_FINAL, topics.KEYFRAME, topics.KEYFRAME_FINAL),
    ),
    Process(
        "meshing",
        "pliant_services.meshing",
        inputs=(
            topics.STREAM,
            topics.MAP_UPDATE,
            topics.KEYFRAME,
            topics.MAP_FINAL,
            topics.KEYFRAME_FINAL,
        ),
        outputs=(topics.MESH_BLOCKS, topics.MESH_FINAL),
        niceness=5,
    ),
    Process(
        "surfels",
        "pliant_services.surfels",
        inputs=(topics.STREAM, topics.IMAGE, topics.DEPTH),
        outputs=(topics.SURFELS,),
    ),
    Process("recorder", "pliant_services.recorder", observer=True),
)

BY_NAME = {process.name: process for process in PROCESSES}

PROFILES: dict[str, tuple[str, ...]] = {
    "rigid": ("ingest", "tracking", "bundle_adjustment", "meshing", "recorder"),
    "points": ("ingest", "tracking", "bundle_adjustment", "recorder"),
    "deformable": ("ingest", "surfels", "recorder"),
}


def reads_depth(fleet: Sequence[str]) -> bool:
    """Whether a service of the fleet works with depth maps."""
    return any(topics.DEPTH in BY_NAME[name].inputs for name in fleet)


def inputs_of(name: str, fleet: Sequence[str], *, images: bool = True) -> dict[Topic, str]:
    """The topics that a service reads in a fleet, each with the service that publishes it.

    images: whether observers read the source's images, too.
    """
    process = BY_NAME[name]
    senders = {t: sender for sender in fleet for t in outputs_of(sender)}
    if process.observer:
        left_out = () if images else (topics.SOURCE, topics.DEPTH)
        return {t: s for t, s in senders.items() if t.logged and t not in left_out}
    return {topic: senders[topic] for topic in process.inputs}


def outputs_of(name: str) -> tuple[Topic, ...]:
    """The topics that a service publishes: its own, and its status."""
    process = BY_NAME[name]
    return () if process.observer else (*process.outputs, topics.status(name))


def readers_of(
    name: str, fleet: Sequence[str], *, images: bool = True
) -> Mapping[Topic, tuple[str, ...]]:
    """For each topic that a service publishes, who in the fleet must read every message."""
    return {
        topic: tuple(reader for reader in fleet if topic in inputs_of(reader, fleet, images=images))
        for topic in outputs_of(name)
    }
