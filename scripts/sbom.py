"""Print what a wheel is and needs as CycloneDX 1.6: names, versions, package URLs and hashes.

python scripts/sbom.py dist/pliant-0.1.0-py3-none-any.whl deploy/requirements/hashes.txt
"""

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_PIN = re.compile(r"([\w.-]+)==([^\s;\\]+)\s*(?:;([^\\]*))?")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")


def bill_of_materials(wheel: Path, pinned: str) -> dict[str, Any]:
    """Of a wheel and the pinned packages that it needs, as pip reads them: the same each time.

    Many files have one version of a package; CycloneDX has the hashes of each as its files.
    """
    name, version = wheel.name.split("-")[:2]
    own = _component(name, version, [hashlib.sha256(wheel.read_bytes()).hexdigest()])
    needs = [_component(*pin) for pin in pins(pinned)]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": own},
        "components": needs,
        "dependencies": [{"ref": own["bom-ref"], "dependsOn": [each["bom-ref"] for each in needs]}],
    }


def pins(pinned: str) -> Iterator[tuple[str, str, list[str]]]:
    """Name, version and SHA-256 of the files of each package."""
    for entry in re.split(r"\n(?=[\w])", pinned):
        found = _PIN.match(entry)
        if found is not None:
            yield found[1], found[2], _HASH.findall(entry)


def _component(name: str, version: str, hashes: list[str]) -> dict[str, Any]:
    purl = f"pkg:pypi/{re.sub(r'[-_.]+', '-', name).lower()}@{version}"
    files = [
        {
            "type": "distribution",
            "url": f"https://pypi.org/project/{name}/{version}/#files",
            "hashes": [{"alg": "SHA-256", "content": each}],
        }
        for each in hashes
    ]
    return {
        "type": "library",
        "bom-ref": purl,
        "name": name,
        "version": version,
        "purl": purl,
        "externalReferences": files,
    }


if __name__ == "__main__":
    bom = bill_of_materials(Path(sys.argv[1]), Path(sys.argv[2]).read_text(encoding="utf-8"))
    print(json.dumps(bom, indent=1))
