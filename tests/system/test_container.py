"""The README's commands on a bare machine: plain Debian, Python, git, a user without rights."""

import os
import shutil
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.docker, pytest.mark.slow, pytest.mark.system]

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 1200
IMAGE = "pliant-test-bare"
DOCKERFILE = """
FROM debian:bookworm-slim
RUN apt-get update && apt-get install --yes --no-install-recommends python3 git
RUN useradd --create-home --home-dir /srv/plain plain
USER plain
"""


def run(*command: object, stdin: bytes | None = None) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(part) for part in command], input=stdin, capture_output=True, timeout=TIMEOUT_S
    )
    output, errors = (stream.decode(errors="replace") for stream in (done.stdout, done.stderr))
    return subprocess.CompletedProcess(done.args, done.returncode, output, errors)


class Machine:
    """A running container with a clone of what is committed here."""

    def __init__(self, name: str) -> None:
        self.name = name

    def shell(
        self, script: str, *, user: str = "plain", stdin: bytes | None = None
    ) -> subprocess.CompletedProcess[str]:
        command = ["docker", "exec", "-i", "-u", user, self.name, "bash", "-c", script]
        return run(*command, stdin=stdin)


@pytest.fixture(scope="module")
def image() -> str:
    if not shutil.which("docker") or run("docker", "info").returncode != 0:
        pytest.skip("no Docker engine answers")
    made = run(ROOT / "scripts" / "base-image")
    if made.returncode != 0:
        pytest.skip(f"no base image: {made.stderr.strip()}")
    built = run("docker", "build", "--tag", IMAGE, "-", stdin=DOCKERFILE.encode())
    if built.returncode != 0:
        pytest.skip(f"containers do not reach Debian's packages here: {built.stderr[-500:]}")
    return IMAGE


@pytest.fixture(scope="module")
def machine(image: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    bundle = tmp_path_factory.mktemp("bundle") / "pliant.bundle"
    bundled = run("git", "-C", ROOT, "bundle", "create", bundle, "HEAD")
    if bundled.returncode != 0:
        pytest.skip(f"not a whole git checkout: {bundled.stderr.strip()}")
    machine = Machine(f"pliant-test-{uuid.uuid4().hex[:12]}")
    # Its home is a volume: installing into the engine's layers takes half as long again.
    options = ["-d", "--name", machine.name, "-v", "/srv/plain"]
    started = run("docker", "run", *options, image, "sleep", "infinity")
    assert started.returncode == 0, started.stderr
    try:
        cloned = machine.shell(
            "cd && cat > pliant.bundle && git clone pliant.bundle pliant", stdin=bundle.read_bytes()
        )
        assert cloned.returncode == 0, cloned.stderr
        give_kernels(machine)
        yield machine
    finally:
        run("docker", "rm", "--force", "--volumes", machine.name)


def give_kernels(machine: Machine) -> None:
    """What numba compiled here for the same sources: compiling again there shows nothing new."""
    cached = sorted(p.relative_to(ROOT) for p in (ROOT / "shared").rglob("*.nb[ic]"))
    names = "\n".join(map(str, cached)).encode()
    packed = subprocess.run(["tar", "-C", ROOT, "-cT-"], input=names, capture_output=True).stdout
    unpacked = machine.shell("tar -C ~/pliant -x", stdin=packed)
    assert unpacked.returncode == 0, unpacked.stderr


@pytest.fixture(scope="module")
def machine_with_venv(machine: Machine) -> Machine:
    """The same machine after what the README asks for."""
    added = machine.shell("apt-get install --yes --no-install-recommends python3-venv", user="root")
    assert added.returncode == 0, added.stderr
    return machine


@pytest.mark.parametrize("script", ["scripts/demo", "scripts/test"])
def test_a_python_without_venv_is_one_line_with_the_command(machine: Machine, script: str) -> None:
    if machine.shell("python3 -c 'import ensurepip'").returncode == 0:
        pytest.skip("python3-venv is there already")
    done = machine.shell(f"cd ~/pliant && {script}")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert "sudo apt install python3-venv" in line


def test_the_demo_sets_itself_up_and_leaves_what_it_names(machine_with_venv: Machine) -> None:
    done = machine_with_venv.shell("cd ~/pliant && scripts/demo built-in:tiny")
    assert done.returncode == 0, done.stdout + done.stderr
    _, heading, list_of_files = done.stdout.rpartition("Results:")
    assert heading
    named = [word for word in list_of_files.split() if word.startswith("results/demo/")]
    assert len(named) == 7  # the mesh is among them
    for name in named:
        assert machine_with_venv.shell(f"test -s ~/pliant/{name}").returncode == 0, name


@pytest.mark.skipif(
    "PLIANT_SOAK" not in os.environ,
    reason="takes minutes: scripts/soak runs it, and CI does the same",
)
def test_the_tests_set_themselves_up(machine_with_venv: Machine) -> None:
    done = machine_with_venv.shell(
        "cd ~/pliant && scripts/test tests/unit -k 'packaging or codec or config'"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
    # Linting and typing need nothing but what was installed from the package index either.
    lint = machine_with_venv.shell("cd ~/pliant && .venv/bin/pyright --version")
    assert lint.returncode == 0, lint.stderr
