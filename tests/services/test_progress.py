"""What a user sees while a run goes on."""

import io

import pytest

from pliant_services.profiles import PROFILES
from pliant_services.run.progress import Progress


@pytest.mark.parametrize(
    ("still_there", "says"),
    [
        (("bundle_adjustment", "meshing", "recorder"), "adjusting the whole map"),
        (("meshing", "recorder"), "fusing the final mesh"),
        (("recorder",), "closing the recording"),
    ],
)
def test_after_the_last_frame_the_bar_shows_the_remaining_work(
    monkeypatch: pytest.MonkeyPatch, still_there: tuple[str, ...], says: str
) -> None:
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("TERM", "xterm")
    assert set(still_there) < set(PROFILES["rigid"])
    with Progress(frames=40) as progress:
        progress.on_rest(still_there)
    assert says in terminal.getvalue()
