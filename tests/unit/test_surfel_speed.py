"""The benchmark of the surfels' speed."""

import pytest
from benchmarks import surfel_speed


def test_every_kind_has_its_row_and_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = {name: surfel_speed.KINDS[name] for name in list(surfel_speed.KINDS)[-2:]}
    monkeypatch.setattr(surfel_speed, "KINDS", kinds)
    text = "\n".join(surfel_speed.measure(None, 1, 20))
    for name in kinds:
        assert f"| {name} |" in text
    assert "together, level 0" in text
    assert "camera alone" in text
