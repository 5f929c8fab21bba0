"""Exactly once, in order, whatever is lost, repeated or restarted: the bus without a network."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant import __version__
from pliant.bus.base import Received, Window
from pliant.bus.checkpoints import Checkpoints, Place
from pliant.bus.inbox import Inbox
from pliant.bus.outbox import Numbered, Outbox
from pliant.bus.peers import Peers, token_key
from pliant.bus.waits import Waiting
from pliant.errors import BusError, SessionOverError
from pliant.messages import topics
from pliant_services.view.command import check_versions

WINDOW = 4


def deliver(inbox: Inbox, message: Numbered) -> None:
    if inbox.is_next(message.sequence, len(message.payload)):
        inbox.put(Received(topics.IMAGE, 0, message.sequence, False, message.payload))


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32), loss=st.floats(0.0, 0.6))
def test_every_message_is_taken_once_and_in_order(seed: int, loss: float) -> None:
    chance = random.Random(seed)
    outbox, inbox = Outbox("t", ["reader"], window=WINDOW), Inbox(limit=2 * WINDOW)
    taken: list[int] = []
    network: list[Numbered] = []
    incarnation, kept_at, safe = 1, 0, 0  # the reader's last checkpoint
    for _ in range(50000):
        if len(taken) == 60:
            break
        step = chance.randrange(6)
        if step == 0 and not outbox.full() and outbox.sent < 60:
            network.append(outbox.add(0, str(outbox.sent).encode()))
        elif step == 1 and network:
            message = network.pop(chance.randrange(len(network)))
            if chance.random() >= loss:
                deliver(inbox, message)
        elif step == 2 and inbox.waiting:
            taken.append(int(inbox.take().data))
        elif step == 3:
            kept_at = safe = len(taken)
        elif step == 4 and chance.random() < 0.05:  # killed, and started again
            incarnation += 1
            del taken[kept_at:]
            inbox = Inbox(limit=2 * WINDOW)
            inbox.start_from(kept_at)
        elif step == 5:  # the counts may be lost, too; asked again later
            if chance.random() >= loss:
                outbox.credit("reader", incarnation, inbox.taken, safe)
            if chance.random() < 0.1:
                network.extend(outbox.again(inbox.taken))
        assert outbox.on_the_way() <= 60
    assert taken == list(range(60))


def test_nothing_is_kept_that_no_reader_can_ask_for() -> None:
    outbox = Outbox("t", ["a", "b"], window=10)
    for _ in range(5):
        outbox.add(0, b"x")
    outbox.credit("a", 1, 5, 5)
    assert outbox.kept() == 5
    outbox.credit("b", 1, 4, 3)
    assert outbox.kept() == 2
    assert [m.sequence for m in outbox.again(3)] == [3, 4]
    with pytest.raises(BusError, match="oldest kept is 3"):
        outbox.again(2)


def test_requested_messages_that_arrived_meanwhile_are_not_sent_again() -> None:
    """After a cut the words of a reader come in one go: the first asks, the last has it all."""
    outbox = Outbox("t", ["a", "b"], window=10)
    for _ in range(6):
        outbox.add(0, b"x")
    outbox.credit("a", 1, 2, 2)
    outbox.credit("b", 1, 6, 6)
    outbox.asking.add("a")
    outbox.credit("a", 1, 5, 5)
    assert [m.sequence for m in outbox.take_requested()] == [5]
    assert outbox.take_requested() == ()
    outbox.asking.add("a")
    outbox.credit("a", 1, 6, 6)
    assert outbox.take_requested() == ()


def test_requested_messages_go_out_some_at_a_time_from_the_first_that_has_not_come() -> None:
    """Newer ones wait for them: in live mode tracking would, too."""
    outbox = Outbox("t", ["slow"], window=20)
    for _ in range(9):
        outbox.add(0, bytes(2 << 20))
    requested: list[list[int]] = []
    for received in (2, 6, 9):  # of which it takes none
        outbox.credit("slow", 1, 0, 0, received=received)
        outbox.asking.add("slow")
        requested.append([message.sequence for message in outbox.take_requested()])
    assert requested == [[2, 3, 4, 5], [6, 7, 8], []]


def test_a_long_wait_is_reported_with_its_length() -> None:
    waiting = Waiting()
    assert waiting.description(now=100.0) == ""
    waiting.begin("an image", now=100.0)
    assert waiting.description(now=101.0) == "an image"
    waiting.begin("an image from afar", now=103.0)  # the same wait
    assert waiting.description(now=105.0) == "an image from afar, for 5 s"
    waiting.end()
    waiting.begin("an image", now=106.0)
    assert waiting.description(now=107.0) == "an image"


def test_who_lacks_what_is_named() -> None:
    windows, lags = {"disk": Window(messages=2, size=100)}, {"slow": Window(messages=9, size=100)}
    outbox = Outbox("t", ["a", "b", "disk", "slow"], window=2, windows=windows, lags=lags)
    assert outbox.silent() == ["a", "b", "disk", "slow"]
    assert outbox.full() == outbox.behind() == outbox.not_safe() == []
    outbox.add(0, b"x")
    outbox.add(0, b"x")
    assert outbox.full() == ["a", "b", "disk", "slow"]
    outbox.credit("a", 1, 2, 2)
    outbox.credit("b", 1, 1, 1)
    outbox.credit("disk", 1, 2, 0)
    assert outbox.silent() == ["slow"]
    assert outbox.full() == ["slow", "disk"]
    assert outbox.full(0, ["slow"]) == ["disk"]
    assert outbox.behind() == ["b"]
    assert outbox.not_safe() == ["b", "disk", "slow"]


def test_counts_fall_only_with_a_new_incarnation() -> None:
    outbox = Outbox("t", ["a"], window=10)
    for _ in range(5):
        outbox.add(0, b"x")
    assert not outbox.credit("a", 7, 4, 2)
    outbox.credit("a", 7, 1, 0)
    assert outbox.readers["a"].taken == 4
    outbox.credit("a", 6, 5, 5)  # what an earlier one sent comes late
    assert outbox.readers["a"].taken == 4
    assert outbox.credit("a", 8, 2, 2)
    assert outbox.on_the_way() == 3


def test_a_reader_that_starts_again_after_its_clock_was_set_back_is_heard() -> None:
    """Nothing would ever tell its sender that it takes what is sent."""
    outbox, peers = Outbox("t", ["a"], window=10), Peers("ingest", incarnation=5, needed=["a"])
    for _ in range(5):
        outbox.add(0, b"x")
    tokens = {number: f"pliant/s/{token_key('a', number)}" for number in (7, 6)}
    peers.on_token(tokens[7], alive=True, now=0.0)
    outbox.credit("a", 7, 4, 2, peers.left("a"))
    peers.on_token(tokens[6], alive=True, now=1.0)
    assert not outbox.credit("a", 6, 3, 3, peers.left("a"))  # both are here
    peers.on_token(tokens[7], alive=False, now=2.0)
    assert outbox.credit("a", 6, 3, 3, peers.left("a"))
    assert not outbox.credit("a", 7, 5, 5, peers.left("a"))  # comes late
    assert (outbox.readers["a"].incarnation, outbox.readers["a"].taken) == (6, 3)


def test_a_reader_that_makes_safe_seldom_bounds_messages_and_bytes() -> None:
    outbox = Outbox("t", ["disk"], window=100, windows={"disk": Window(messages=3, size=25)})
    outbox.add(0, b"0123456789")
    assert not outbox.full(10)
    outbox.add(0, b"0123456789")
    assert outbox.full(10)
    assert not outbox.full(5)
    outbox.add(0, b"")
    assert outbox.full(0)
    outbox.credit("disk", 1, 3, 3)
    assert not outbox.full(1000)  # nothing is kept: larger than the window may pass alone


def test_what_is_on_the_way_and_what_waits_is_bounded_in_bytes() -> None:
    """One larger than that goes alone."""
    outbox, inbox = Outbox("t", ["a"], window=9, window_bytes=25), Inbox(9, limit_bytes=25)
    assert not outbox.full(100)
    for _ in range(2):
        deliver(inbox, outbox.add(0, b"0123456789"))
    assert not outbox.full(5)
    assert outbox.full(6) == ["a"]
    assert inbox.is_next(2, 5)
    assert not inbox.is_next(2, 6)
    assert inbox.refused == 1
    inbox.take()
    outbox.credit("a", 1, 1, 1)
    assert not outbox.full(15)
    assert inbox.is_next(2, 15)
    assert not inbox.is_next(2, 16)
    inbox.take()
    assert inbox.is_next(2, 100)


def test_messages_with_which_a_reader_may_lag_take_no_room_in_its_window() -> None:
    lags = {"slow": Window(messages=6, size=50)}
    outbox = Outbox("t", ["slow", "fast"], window=2, lags=lags)
    for _ in range(2):
        outbox.add(0, b"x")
    assert outbox.full(1)
    assert outbox.full(1, ["slow"])  # the other one has no room
    outbox.credit("fast", 1, 2, 2)
    assert outbox.untaken("slow") == 2
    for sent in range(2, 6):
        assert outbox.full(1)
        assert not outbox.full(1, ["slow"])
        outbox.add(0, b"x", ["slow"])
        outbox.credit("fast", 1, sent + 1, sent + 1)
    assert outbox.full(1, ["slow"])  # six are on the way
    outbox.credit("slow", 1, 2, 0)
    assert not outbox.full(46, ["slow"])
    assert outbox.full(47, ["slow"])  # four bytes are on the way
    outbox.add(0, b"x")
    assert not outbox.full(1)  # one of those in the window
    outbox.credit("fast", 1, 7, 7)
    outbox.add(0, b"x")
    outbox.credit("fast", 1, 8, 8)
    assert outbox.full(1)
    outbox.credit("slow", 2, 0, 0)  # it starts anew, and lags with the same messages
    assert outbox.untaken("slow") == 8
    assert outbox.full(1)
    outbox.credit("slow", 2, 3, 3)
    assert outbox.full(1)
    outbox.credit("slow", 2, 7, 7)
    assert not outbox.full(1)
    assert outbox.untaken("nobody") == 0


def test_versions_that_do_not_fit_are_both_named() -> None:
    """Also where only the fields of messages are others; the release alone does not decide."""
    other_fields = token_key("ingest", 3)[:-8] + "01234567"
    for token in ("ready/ingest/3/99/9.9.9", "ready/ingest/3/99/9.9.9+01234567", other_fields):
        peers = Peers("tracking", incarnation=5, needed=["ingest"])
        peers.on_token(f"pliant/s/{token}", alive=True, now=0.0)
        with pytest.raises(
            BusError, match=f"ingest is pliant .* tracking is {__version__}"
        ) as said:
            peers.raise_if_refused()
        assert "\n" not in str(said.value)


def test_a_viewer_of_another_version_names_both() -> None:
    own = [f"pliant/s/{token_key('ingest', 3)}", "pliant/s/ready/nonsense"]
    check_versions(own)
    for token in ("ready/ingest/3/99/9.9.9", token_key("ingest", 3)[:-8] + "01234567"):
        with pytest.raises(BusError, match=f"ingest is pliant .* viewer is {__version__}") as said:
            check_versions([*own, f"pliant/s/{token}"])
        assert "\n" not in str(said.value)


@pytest.mark.parametrize("stranger", ["ingest/9", "tracking/9", "surfels/9"])
def test_a_stranger_of_another_version_is_reported_and_stops_no_service(stranger: str) -> None:
    """Neither under a name that is here, nor under our own, nor under one that nobody needs."""
    peers = Peers("tracking", incarnation=5, needed=["ingest"])
    for name, number in (("ingest", 3), ("tracking", 5)):
        peers.on_token(f"pliant/s/{token_key(name, number)}", alive=True, now=0.0)
    for alive in (True, False):
        peers.on_token(f"pliant/s/ready/{stranger}/99/9.9.9", alive=alive, now=0.0)
        peers.raise_if_refused()
    assert peers.missing(["ingest"]) == []
    assert peers.missing(["surfels"]) == ["surfels"]
    (line,) = peers.strangers.values()
    assert "pliant 9.9.9" in line


def test_a_service_that_came_back_is_not_gone() -> None:
    peers = Peers("tracking", incarnation=5)

    def token(number: int) -> str:
        return f"pliant/s/{token_key('ingest', number)}"

    peers.on_token(token(1), alive=True, now=0.0)
    peers.on_token(token(2), alive=True, now=1.0)
    peers.on_token(token(1), alive=False, now=2.0)
    assert peers.missing(["ingest"]) == []
    peers.on_token(token(2), alive=False, now=3.0)
    assert peers.missing(["ingest"]) == ["ingest"]
    assert peers.absent(["ingest", "tracking"]) == "ingest (away), tracking (not here yet)"
    assert peers.lost(["ingest"], patience_s=5.0, now=7.0) == []
    assert peers.lost(["ingest"], patience_s=5.0, now=8.0) == ["ingest"]


def test_a_second_service_of_the_same_name_takes_over() -> None:
    peers = Peers("tracking", incarnation=5)
    peers.on_token(f"pliant/s/{token_key('tracking', 4)}", alive=True, now=0.0)
    peers.raise_if_refused()
    peers.on_token(f"pliant/s/{token_key('tracking', 6)}", alive=True, now=0.0)
    with pytest.raises(BusError, match="has replaced this one"):
        peers.raise_if_refused()


def test_a_service_that_stays_gives_way_to_no_newer_one() -> None:
    peers = Peers("recorder", incarnation=5, stays=True)
    peers.on_token(f"pliant/s/{token_key('recorder', 6)}", alive=True, now=0.0)
    peers.raise_if_refused()


def test_the_newest_checkpoint_that_readers_allow_is_used(tmp_path) -> None:
    checkpoints = Checkpoints(tmp_path / "tracking", interval=10)
    for frame in (9, 19, 29):
        assert checkpoints.due(frame)
        place = Place(frame, {"in": frame + 1}, {"out": frame + 1})
        checkpoints.save(place, f"state {frame}".encode(), lambda: None)
        checkpoints.close()
    assert not checkpoints.due(30)

    again = Checkpoints(tmp_path / "tracking", interval=10)
    assert again.usable({"out": 5}) is None
    place = again.usable({"out": 25})
    assert place == Place(19, {"in": 20}, {"out": 20})
    assert sorted(path.name for path in (tmp_path / "tracking").iterdir()) == [
        "000000019.state",
        "000000029.state",
    ]
    assert again.restart_from(place) == b"state 19"
    assert [path.name for path in (tmp_path / "tracking").iterdir()] == ["000000019.state"]


def test_who_was_here_before_us_is_not_awaited_for_ever() -> None:
    peers = Peers("ingest", incarnation=5)
    peers.on_token(f"pliant/s/{token_key('tracking', 1)}", alive=True, now=0.0)
    peers.expect(["tracking", "recorder"], now=1.0)
    assert peers.lost(["tracking", "recorder"], patience_s=60.0, now=60.0) == []
    assert peers.lost(["tracking", "recorder"], patience_s=60.0, now=61.0) == ["recorder"]


def test_no_service_waits_once_the_session_is_over() -> None:
    peers = Peers("ingest", incarnation=5)
    peers.raise_if_refused()
    peers.over = True
    with pytest.raises(SessionOverError, match="ingest"):
        peers.raise_if_refused()
