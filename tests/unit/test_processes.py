"""The table of processes describes a network that can run."""

import importlib
from pathlib import Path

import pytest

from pliant.config import Config
from pliant.messages import topics
from pliant_services import processes
from pliant_services.processes import PROCESSES
from pliant_services.profiles import NAMES, PROFILES
from pliant_services.runtime.host import checkpoint_windows


@pytest.mark.parametrize("profile", sorted(PROFILES))
def test_every_input_has_one_sender_and_no_way_leads_back(profile: str) -> None:
    fleet = PROFILES[profile]
    done: set[str] = set()
    for name in fleet:  # in the order of the table: senders come before their readers
        senders = set(processes.inputs_of(name, fleet).values())
        assert senders <= done, f"{name} reads {senders - done}, which come after it"
        done.add(name)


@pytest.mark.parametrize("profile", sorted(PROFILES))
def test_the_recorder_gets_everything_that_is_logged(profile: str) -> None:
    fleet = PROFILES[profile]
    published = {t for name in fleet for t in processes.outputs_of(name)}
    recorded = set(processes.inputs_of("recorder", fleet))
    assert recorded == {topic for topic in published if topic.logged}
    for name in fleet:
        for topic, readers in processes.readers_of(name, fleet).items():
            assert ("recorder" in readers) == topic.logged


def test_profiles_name_all_services_and_no_other() -> None:
    assert set(NAMES) == set(processes.BY_NAME)


def test_every_topic_of_the_table_is_published_by_one_process() -> None:
    published = [t.key for process in PROCESSES for t in processes.outputs_of(process.name)]
    assert len(published) == len(set(published))
    known = {t.key for t in topics.TOPICS} - {topics.STREAM_END.key}
    assert {key for key in published if not key.startswith("status/")} == known
    assert [topics.by_key(key) for key in ("status/anything", "status/", "no/topic")] == [
        topics.status("anything"), None, None,
    ]  # fmt: skip


@pytest.mark.parametrize("process", PROCESSES, ids=lambda p: p.name)
def test_every_process_has_a_module_with_run(process: processes.Process) -> None:
    module = importlib.import_module(process.module)
    assert callable(module.run)
    assert callable(getattr(module, "warm_up", None)) == process.kernels


def test_messages_kept_for_checkpoints_are_as_documented() -> None:
    windows = checkpoint_windows(Config(), PROFILES["points"])
    assert {name: window.messages for name, window in windows.items()} == {
        "tracking": 784,
        "bundle_adjustment": 536,
    }
    docs = (Path(__file__).parents[2] / "docs" / "faults.md").read_text(encoding="utf-8")
    assert all(f"| {window.messages} |" in docs for window in windows.values())
