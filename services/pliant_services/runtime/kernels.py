"""Compiles every kernel once, before services start together and would each compile them all."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import pliant
from pliant import arithmetic
from pliant.cache import cache_folder
from pliant.errors import PliantError
from pliant.programs import PYTHON
from pliant_services.processes import BY_NAME, COMPILED


def compile_kernels(say: Callable[[str], None]) -> None:
    """Fill numba's cache on disk unless this version's kernels are there already."""
    stamp = cache_folder() / "compiled" / _fingerprint()
    if stamp.exists():
        return
    say("compiling kernels (once, about a minute) ...")
    # In processes of their own: the launcher stays small, a crash of the compiler is one line.
    compilers = {service: start_compiler(service) for service in COMPILED}
    try:
        for number, (service, compiler) in enumerate(compilers.items(), start=1):
            assert compiler.stderr is not None
            errors = compiler.stderr.read()
            if compiler.wait() != 0:
                words = errors.strip() or f"the compiler ended with code {compiler.returncode}"
                raise PliantError(f"compiling the kernels of {service} failed:\n{words}")
            say(f"compiled {service} ({number} of {len(compilers)})")
    finally:
        for compiler in compilers.values():
            end_compiler(compiler)
    with suppress(OSError):  # without the stamp the next run checks once more, that is all
        stamp.parent.mkdir(parents=True, exist_ok=True)
        stamp.touch()


def start_compiler(service: str) -> subprocess.Popen[str]:
    """Compile the kernels of a service in a process that ends with this one, whatever kills it."""
    code = (
        # Garbage is looked for seldom: that took a tenth of the time.
        "import gc; gc.set_threshold(100_000, 20, 100); "
        "from pliant_services.runtime.host import end_with_launcher; end_with_launcher(); "
        f"from {BY_NAME[service].module} import warm_up; warm_up()"
    )
    return subprocess.Popen(
        [*PYTHON, "-c", code],
        stdin=subprocess.PIPE,  # never written: it closes when the launcher is gone
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C reaches the launcher alone
    )


def end_compiler(compiler: subprocess.Popen[str]) -> None:
    """Kill a compiler if it still works, and let go of its pipes."""
    compiler.kill()
    compiler.wait()
    for pipe in (compiler.stdin, compiler.stderr):
        if pipe is not None:
            pipe.close()


def _fingerprint() -> str:
    digest = hashlib.sha256()
    root, nodes = Path(pliant.__file__).parent, Path(__file__).parents[1] / "nodes"
    for path in (*sorted(root.rglob("*.py")), *sorted(nodes.glob("*.py"))):
        digest.update(f"{path} {path.stat().st_mtime_ns}".encode())
    # Without assertions and docstrings kernels have other bytes, and are compiled once more.
    where = f"{root} {os.environ.get('NUMBA_CACHE_DIR', '')} {sys.flags.optimize}"
    digest.update(f"{where} {sys.version} {version('numba')} {arithmetic.target()}".encode())
    return digest.hexdigest()[:24]
