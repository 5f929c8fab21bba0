"""What a release says of what it is made of: hashes of all that is pinned, and a CycloneDX list."""

import re
import subprocess
import sys
from json import loads
from pathlib import Path

ROOT = Path(__file__).parents[2]
LOCKS = ROOT / "deploy" / "requirements"
HASHES = LOCKS / "hashes.txt"


def pinned(text: str) -> set[tuple[str, str]]:
    return set(re.findall(r"^([\w.-]+)==([^\s;\\]+)", text, re.MULTILINE))


def test_all_that_is_pinned_has_hashes_and_the_same_version() -> None:
    """``scripts/lock hashes`` makes them."""
    text = HASHES.read_text()
    assert pinned(text) == pinned((LOCKS / "run.txt").read_text())
    for entry in re.split(r"\n(?=\w)", text):
        assert "--hash=sha256:" in entry


def test_a_wheel_lists_what_it_is_and_needs(tmp_path: Path) -> None:
    wheel = tmp_path / "pliant-1.2.3-py3-none-any.whl"
    wheel.write_bytes(b"wheel")
    made = subprocess.run(
        [sys.executable, ROOT / "scripts" / "sbom.py", wheel, HASHES],
        capture_output=True,
        check=True,
        text=True,
    )
    bom = loads(made.stdout)
    assert (bom["bomFormat"], bom["specVersion"]) == ("CycloneDX", "1.6")
    own = bom["metadata"]["component"]
    assert own["purl"] == "pkg:pypi/pliant@1.2.3"
    assert {(c["name"], c["version"]) for c in bom["components"]} == pinned(HASHES.read_text())
    assert all(c["externalReferences"] for c in [own, *bom["components"]])
    (depends,) = bom["dependencies"]
    assert {*depends["dependsOn"]} == {c["bom-ref"] for c in bom["components"]}
