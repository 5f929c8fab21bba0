"""Compiles every kernel once, before services start together and would each compile them all."""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pliant
from pliant.cache import cache_folder
from pliant.errors import PliantError

COMPILED = ("tracking", "bundle_adjustment", "meshing", "surfels")
"""The services that have kernels."""


def compile_kernels(say: Callable[[str], None]) -> None:
    """Fill numba's cache on disk unless this version's kernels are there already."""
    stamp = cache_folder() / "compiled" / _fingerprint()
    if stamp.exists():
        return
    say("compiling kernels (once, about a minute) ...")
    # In processes of their own: the launcher stays small, a crash of the compiler is one line.
    compilers = {service: _start_compiler(service) for service in COMPILED}
    try:
        for number, (service, compiler) in enumerate(compilers.items(), start=1):
            _, errors = compiler.communicate()
            if compiler.returncode != 0:
                words = errors.strip() or f"the compiler ended with code {compiler.returncode}"
                raise PliantError(f"compiling the kernels of {service} failed:\n{words}")
            say(f"compiled {service} ({number} of {len(compilers)})")
    finally:
        for compiler in compilers.values():
            compiler.kill()
            compiler.wait()
    with suppress(OSError):  # without the stamp the next run checks once more, that is all
        stamp.parent.mkdir(parents=True, exist_ok=True)
        stamp.touch()


def _start_compiler(service: str) -> subprocess.Popen[str]:
    code = f"from pliant_services.warm_up import load_kernels; load_kernels({service!r})"
    command = [sys.executable, "-c", code]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def load_kernels(service: str) -> None:
    """Call every kernel of a service on a small input with the types that it meets.

    Compiles what is not in the cache; otherwise loads it, so that the first frame is as quick as
    all others.  Services without kernels have nothing to load.
    """
    if service == "tracking":
        from pliant.algorithms import tracking

        tracking.warm_up()
    elif service == "bundle_adjustment":
        from pliant.algorithms import bundle, mapping

        bundle.warm_up()
        mapping.warm_up(mapping.MappingParameters())
    elif service == "meshing":
        from pliant.algorithms import meshing
        from pliant.fusion.open3d_import import FusionError
        from pliant.fusion.warm_up import warm_up as fuse_something

        meshing.warm_up()
        with suppress(FusionError):  # where there is no open3d there is no mesh
            fuse_something()
    elif service == "surfels":
        from pliant.algorithms import surfels

        surfels.warm_up()


def _fingerprint() -> str:
    import llvmlite.binding as llvm
    import numba

    digest = hashlib.sha256()
    root = Path(pliant.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)} {path.stat().st_mtime_ns}".encode())
    digest.update(f"{root} {sys.version} {numba.__version__} {llvm.get_host_cpu_name()}".encode())
    return digest.hexdigest()[:24]
