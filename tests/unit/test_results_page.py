"""The tables of docs/results.md: made by the declared commands, and put where the page has them."""

import json
import re
from pathlib import Path

import pytest
from benchmarks.results_page import commands_block, make, rendered
from benchmarks.results_tables import TABLES, Output, Table, as_printed, final_online

from pliant.errors import PliantError

PAGE = Path(__file__).parents[2] / "docs" / "results.md"
HEADER = (
    "| sequence | seed | ATE, final | ATE, online | frames with a pose |\n|---|---|---|---|---|"
)


def output(command: str, *rows: str) -> Output:
    return Output(command, "\n".join([HEADER, *rows]) + "\n")


def test_the_page_has_every_table_with_its_commands_and_its_commit() -> None:
    blocks = re.findall(
        r"^<!-- bench ([\w-]+) -->\n(.*?)^<!-- end -->$", PAGE.read_text(), re.DOTALL | re.MULTILINE
    )
    assert [name for name, _ in blocks] == list(TABLES)
    for name, body in blocks:
        assert body.startswith(commands_block(TABLES[name])), name
        assert re.search(r"^\*Commit [0-9a-f]{7}.*, \d{4}-\d\d-\d\d.*\*$", body, re.MULTILINE), name
    outside = re.sub(r"<!-- bench .*?<!-- end -->", "", PAGE.read_text(), flags=re.DOTALL)
    assert "\n|" not in outside


def test_rows_below_the_same_header_are_one_table() -> None:
    shown = as_printed([output("one", "| a |"), output("two", "| b |"), Output("x", "three\n")])
    assert shown == f"{HEADER}\n| a |\n| b |\n\n```\nthree\n```"


def test_seeds_and_settings_are_columns() -> None:
    rows = "| room | 0 | 1 mm | 2 mm | 100.0 % |", "| room | 1 | 3 mm | 4 mm | 96.9 % |"
    seeds = final_online([output("scripts/bench in-process room --seeds 2", *rows)])
    assert seeds.splitlines()[0] == "| sequence | seed 0 | seed 1 |"
    assert seeds.splitlines()[2] == "| room | 1 mm / 2 mm | 3 mm / 4 mm at 96.9 % |"
    plain = output("scripts/bench in-process room", rows[0])
    less = output("scripts/bench in-process room --set tracking.max_tracks=2000", rows[0])
    assert final_online([plain, less]).splitlines()[0] == "| sequence | default | max_tracks |"


def test_a_table_without_raw_results_stays_as_it_is(tmp_path: Path) -> None:
    page = (
        "words\n<!-- bench codec -->\nold\n<!-- end -->\n"
        "<!-- bench tracking -->\nkept\n<!-- end -->\nwords\n"
    )
    assert rendered(page, tmp_path) == page
    made = [{"command": "scripts/bench codec", "text": "| new |\n"}]
    content = {"commit": "abc1234", "date": "2026-01-02", "outputs": made}
    (tmp_path / "codec.json").write_text(json.dumps(content))
    table = "```sh\nscripts/bench codec\n```\n\n*Commit abc1234, 2026-01-02.*\n\n| new |\n\n"
    assert rendered(page, tmp_path) == page.replace("old\n", table)
    with pytest.raises(PliantError, match="a table unheard-of: choose accuracy, seeds"):
        rendered("<!-- bench unheard-of -->\n<!-- end -->", tmp_path)


def test_measured_once_at_a_commit_and_a_failure_has_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, raw = tmp_path / "page.md", tmp_path / "raw"
    page.write_text("<!-- bench codec -->\n<!-- end -->\n")

    def told(only: str, commit: str = "abc1234") -> list[str]:
        return list(make(page, [only], data=tmp_path, raw=raw, run=True, commit=commit))

    assert told("codec")[0] == "codec: about 1 minutes"
    assert "| unpack and check |" in page.read_text()
    assert told("codec") == ["codec: already measured at abc1234"]
    monkeypatch.setitem(TABLES, "codec", Table(1, ("pliant info nowhere",)))
    with pytest.raises(PliantError, match=r"pliant info nowhere: exit code 1: .*nowhere"):
        told("codec", "abc1234-dirty")
    with pytest.raises(PliantError, match="--only lunch: choose accuracy, seeds"):
        told("lunch")
