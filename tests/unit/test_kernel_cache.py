"""Kernels on disk: kept between processes, compiled anew when what they are built from changes,
and the same code in the process that compiled them and in all others."""

import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from numba.core.caching import NullCache

import pliant
from pliant import cache, errors
from pliant.compiler import (
    kernel,
    kernel_cache,
    kernel_linking,
    kernel_loading,
    reference_counts,
    subroutines,
)

_KERNEL = """
from pliant.compiler.kernel import kernel
from pliant.algorithms.constants import (
    FACTOR,
)

@kernel
def scaled(x):
    return FACTOR * x
"""
_CALL = (
    "from pliant.algorithms.scaled import scaled; "
    "print(scaled(2.0), sum(scaled.stats.cache_hits.values()))"
)
# A helper that calls itself is never wholly part of its caller.
_HELPED = """
from pliant.compiler.kernel import kernel

@kernel
def helper(x):
    return x if x < 2.0 else helper(x - 1.0) + helper(x - 2.0)

@kernel
def helped(x):
    return 3.0 * helper(x)
"""


# A kernel whose arguments are of a type of ours.
_TYPED = """
from typing import NamedTuple
from pliant.compiler.kernel import kernel

class Pair(NamedTuple):
    first: float
    second: float

@kernel
def added(pair):
    return pair.first + pair.second
"""


# A kernel that makes an array, and one that calls it.
_ARRAY = """
import numpy as np
from pliant.compiler.kernel import kernel

@kernel
def doubled(x):
    return x + x
"""
_CALLER = """
from pliant.compiler.kernel import kernel
from pliant.algorithms.doubled import doubled

@kernel
def total(x):
    return doubled(x).sum()
"""


def _package(root: Path) -> Path:
    package, compiler = (root / "pliant" / name for name in ("algorithms", "compiler"))
    for folder in (package, compiler):
        folder.mkdir(parents=True)
    ours = kernel, kernel_cache, kernel_linking, kernel_loading, reference_counts, subroutines
    for module in ours:
        source = Path(module.__file__)
        (compiler / source.name).write_bytes(source.read_bytes())
    for module in (cache, errors):
        source = Path(module.__file__)
        (package.parent / source.name).write_bytes(source.read_bytes())
    for folder in (package, compiler, package.parent):
        (folder / "__init__.py").touch()
    return package


def _call(
    root: Path, code: str = _CALL, environment: Mapping[str, str] = MappingProxyType({})
) -> str:
    command = [sys.executable, "-B", "-c", code]
    env = {"PYTHONPATH": str(root), **environment}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_the_type_of_an_argument_may_have_another_name(tmp_path: Path) -> None:
    package = _package(tmp_path)
    call = "from pliant.algorithms.typed import added, {0}; print(added({0}(1.0, 2.0)))"
    for name in ("Pair", "Couple"):
        (package / "typed.py").write_text(_TYPED.replace("Pair", name))
        assert _call(tmp_path, call.format(name)) == "3.0"


def test_a_constant_of_another_module_changes_the_kernel(tmp_path: Path) -> None:
    package = _package(tmp_path)
    (package / "scaled.py").write_text(_KERNEL)

    (package / "constants.py").write_text("FACTOR = 3.0\n")
    assert _call(tmp_path) == "6.0 0"
    assert _call(tmp_path) == "6.0 1"
    (package / "constants.py").write_text("FACTOR = 5.0\n")
    assert _call(tmp_path) == "10.0 0"


def test_sources_are_followed_through_imports() -> None:
    library = Path(pliant.__file__).parent
    paths = kernel_cache.sources(library / "algorithms" / "tracking" / "advance.py")
    found = {str(path.relative_to(library)) for path in paths}
    assert {"algorithms/tracking/advance.py", "compiler/kernel.py"} <= found
    assert {"compiler/kernel_cache.py", "algorithms/image/patch_alignment.py"} <= found
    assert not any(name.startswith("algorithms/slam/") for name in found)


def test_a_kernel_calls_the_helpers_in_its_own_object_file(tmp_path: Path) -> None:
    """The linker would take those of whichever kernel was loaded first: they may round unlike."""
    package = _package(tmp_path)
    (package / "helped.py").write_text(_HELPED)
    call = "from pliant.algorithms.helped import helped; print(helped(9.0))"
    assert _call(tmp_path, call) == _call(tmp_path, call) == "102.0"
    (file,) = package.rglob("helped.helped-*.nbc")
    found = [binding for name, binding in _functions(_object(file)) if "helper" in name]
    assert found == ["local"]


def test_a_kernel_from_disk_needs_no_compiler_and_is_linked_into_one_compiled_later(
    tmp_path: Path,
) -> None:
    package = _package(tmp_path)
    (package / "doubled.py").write_text(_ARRAY)
    (package / "caller.py").write_text(_CALLER)
    one = (
        "import sys, numpy as np; from pliant.algorithms.doubled import doubled; "
        "print(doubled(np.ones(3)).sum(), *doubled.stats.cache_hits.values(), "
        "'numba.misc.cffiimpl' in sys.modules)"
    )
    both = "; from pliant.algorithms.caller import total; print(total(np.ones(3)))"
    assert _call(tmp_path, one) == "6.0 True"
    assert _call(tmp_path, one + both).split() == ["6.0", "1", "False", "6.0"]
    assert _call(tmp_path, one + both).split() == ["6.0", "1", "False", "6.0"]


def test_kernels_go_to_the_cache_folder_where_the_sources_are_not_to_be_written(
    tmp_path: Path,
) -> None:
    package = _package(tmp_path)
    (package / "constants.py").write_text("FACTOR = 3.0\n")
    (package / "scaled.py").write_text(_KERNEL)
    (package / "__pycache__").touch()  # no folder can be made there
    there = {"PLIANT_CACHE_DIR": str(tmp_path / "cache")}
    assert _call(tmp_path, environment=there) == "6.0 0"
    assert _call(tmp_path, environment=there) == "6.0 1"
    assert list((tmp_path / "cache" / "kernels").rglob("scaled*.nbc"))


def test_one_line_warns_that_kernels_cannot_be_cached(tmp_path: Path) -> None:
    package = _package(tmp_path)
    (package / "constants.py").write_text("FACTOR = 3.0\n")
    (package / "scaled.py").write_text(_KERNEL)
    (package / "__pycache__").touch()
    code = (
        "from pliant.errors import PliantError\n"
        "try: import pliant.algorithms.scaled\n"
        "except PliantError as error: print(error)"
    )
    for nowhere in ({"PLIANT_CACHE_DIR": "/dev/null/here"}, {"HOME": "/dev/null"}):
        line = _call(tmp_path, code, nowhere)
        assert "set PLIANT_CACHE_DIR to a writable folder" in line
        assert "\n" not in line


def test_a_slice_of_another_shape_is_an_error_without_strings() -> None:
    @kernel.kernel
    def copy(source: np.ndarray, target: np.ndarray) -> None:
        target[:] = source

    with pytest.raises(ValueError, match="an array of another shape"):
        copy(np.zeros(3), np.zeros(4))


def test_fast_kernels_are_without_estimates_that_differ_between_processors() -> None:
    @kernel.fast_kernel
    def normalised(x: np.float32, y: np.float32) -> np.float32:
        return x / np.sqrt(y)

    normalised._cache = NullCache()  # type: ignore[attr-defined]  # of a loaded one numba shows none
    assert normalised(np.float32(3.0), np.float32(4.0)) == 1.5
    (code,) = normalised.inspect_asm().values()  # type: ignore[attr-defined]
    assert "sqrt" in code
    assert "rsqrt" not in code


def test_a_power_is_as_strict_as_its_kernel_whichever_was_compiled_first() -> None:
    def power(x: float, n: int) -> float:
        return x**n

    for order in ("fast", "strict"), ("strict", "fast"):
        codes: dict[str, str] = {}
        for name in order:
            compiled = (kernel.fast_kernel if name == "fast" else kernel.kernel)(power)
            compiled._cache = NullCache()  # type: ignore[attr-defined]
            assert compiled(2.0, 3) == 8.0
            (codes[name],) = compiled.inspect_llvm().values()  # type: ignore[attr-defined]
        assert "fmul reassoc" in codes["fast"]
        assert "fmul reassoc" not in codes["strict"]


def test_a_kernel_is_strict_for_every_first_caller() -> None:
    @kernel.kernel
    def strict(a: float, b: float, c: float) -> float:
        return a * b + c

    @kernel.fast_kernel
    def fast(a: float, b: float, c: float) -> float:
        return strict(a, b, c)

    nearly = 2.0**-30
    assert fast(1.0 + nearly, 1.0 - nearly, -1.0) == 0.0  # in one operation it would be -2^-60
    assert strict(1.0 + nearly, 1.0 - nearly, -1.0) == 0.0


def test_kernels_load_no_blas() -> None:
    code = (
        "import sys, pliant.compiler.kernel, numba.np.arraymath; "
        "sys.exit('scipy.linalg' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_what_makes_no_array_counts_no_references() -> None:
    @kernel.kernel
    def deep(values: np.ndarray, place: int) -> float:
        return values[place] if place < 2 else deep(values, place - 1) + deep(values, place - 2)

    @kernel.kernel
    def sums(values: np.ndarray, out: np.ndarray) -> None:
        for row in range(len(values)):
            out[row] = deep(values[row], 2)

    out = np.zeros(2)
    sums(np.arange(4.0).reshape(2, 2), out)
    assert list(out) == [1.0, 5.0]
    (code,) = sums.inspect_llvm().values()  # type: ignore[attr-defined]
    assert "NRT_" not in code


def test_an_array_that_a_kernel_hands_out_or_makes_is_counted() -> None:
    @kernel.kernel
    def last(rows: np.ndarray) -> np.ndarray:
        return rows[-1]

    @kernel.kernel
    def sum_of_doubled(rows: np.ndarray) -> float:
        doubled = 2.0 * last(rows)
        return doubled.sum()

    rows = np.arange(1000.0).reshape(2, 500)
    handed_out = last(rows)
    before = sys.getrefcount(rows)
    assert sum_of_doubled(rows) == 2.0 * rows[1].sum()
    assert sys.getrefcount(rows) == before
    del rows
    np.full((2, 500), -1.0)
    assert handed_out[-1] == 999.0


def _object(file: Path) -> bytes:
    """The object file that Numba keeps there among other things."""
    data = file.read_bytes()
    return data[data.index(b"\x7fELF") :]


def _functions(elf: bytes) -> Iterator[tuple[str, str]]:
    """Names and bindings of the functions that a 64-bit ELF file defines."""
    assert elf[:5] == b"\x7fELF\x02"
    sections_at = struct.unpack_from("<Q", elf, 40)[0]
    count = struct.unpack_from("<H", elf, 60)[0]
    sections = [struct.unpack_from("<IIQQQQIIQQ", elf, sections_at + 64 * i) for i in range(count)]
    (table,) = [section for section in sections if section[1] == 2]
    names = sections[table[6]][4]
    for at in range(table[4], table[4] + table[5], 24):
        name, info, _, section, _, _ = struct.unpack_from("<IBBHQQ", elf, at)
        if info & 15 == 2 and section != 0:
            start = names + name
            yield (
                elf[start : elf.index(b"\0", start)].decode(),
                {0: "local", 1: "global", 2: "weak"}[info >> 4],
            )


def test_kernels_without_assertions_are_others() -> None:
    """What is compiled for one of them is not there for the other."""
    code = "from pliant_services.runtime.kernels import _fingerprint; print(_fingerprint())"
    plain, optimised = (
        subprocess.run([sys.executable, *flags, "-c", code], capture_output=True, check=True).stdout
        for flags in ((), ("-OO",))
    )
    assert plain != optimised
