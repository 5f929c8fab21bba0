"""The same bytes, whatever the processor can do beyond AVX2 and however many threads BLAS likes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import reference

from pliant import arithmetic

TESTS = Path(__file__).parents[1]

# A user's script: numpy first.
_ADJUSTMENT = """
import hashlib
import numpy
from bundle_scene import make_scene
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.algorithms.slam.estimate.schur import solve_schur
problem = make_scene(cameras=40, points=300, noise_px=0.5, visible=0.4).problem
result = solve_schur(problem, BundleParameters())
print(hashlib.sha256(result.T_world_camera.tobytes()).hexdigest())
"""
_RECORDING = TESTS / "data" / "reference" / "reference.mcap"
# As if this were a processor with less, as far as libraries can be told: Pliant overrides it.
_LESSER = {
    "NUMBA_CPU_NAME": "nehalem",
    "NUMBA_CPU_FEATURES": "",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4",
    "OPENBLAS_CORETYPE": "Nehalem",
    "OPENCV_CPU_DISABLE": "AVX2",
    "OPENCV_IPP": "sse42",
}
# What nothing overrides: glibc computes sin and exp without FMA, which gives other last bits, and
# numpy, told when Pliant has had its say, with none of the code that it chooses by the processor.
_C_LIBRARY = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA"}
_NUMPY = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
_REFERENCE = f"""
import json, os, pliant
os.environ["NPY_DISABLE_CPU_FEATURES"] = {_NUMPY!r}
import reference
made = reference.replay(reference.Path({str(_RECORDING)!r}))
print(json.dumps([made["topics"], pliant.arithmetic.in_force()]))
"""
_FIXED = pytest.mark.skipif(
    arithmetic.target() != arithmetic.TARGET, reason="a processor without AVX2"
)


def _answer(code: str, environment: dict[str, str]) -> str:
    """What a process prints that inherits nothing of what this one has set."""
    ours = arithmetic.VARIABLES
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    paths = os.pathsep.join(str(TESTS / folder) for folder in ("", "unit", "replay"))
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**kept, "PYTHONPATH": paths, **environment},
        cwd=TESTS.parent,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_threads_of_blas_change_nothing() -> None:
    """An adjustment of some size: the factors of its reduced system once depended on them."""
    answers = {_answer(_ADJUSTMENT, {"OPENBLAS_NUM_THREADS": threads}) for threads in ("1", "4")}
    assert len(answers) == 1


@_FIXED
def test_a_lesser_processor_makes_the_same_of_the_reference() -> None:
    """Tracks, map, mesh and surfels: a user's environment changes nothing of LLVM, BLAS and OpenCV,
    and what numpy and the C library choose by the processor changes no byte.

    BLAS for Nehalem and OpenCV without AVX2 would: that they are overridden is half of the proof.
    That they do the same on each processor with AVX2 only an emulated one can tell.
    """
    topics, with_what = json.loads(_answer(_REFERENCE, {**_LESSER, **_C_LIBRARY}))
    ours = json.loads(_RECORDING.with_name(reference.EXPECTED).read_text(encoding="utf-8"))
    if ours["fingerprint"] != reference.fingerprint():  # else test_reference.py compares the bytes
        ours = reference.replay(_RECORDING)
    assert topics == ours["topics"]
    in_force = arithmetic.in_force()
    assert {name for name in in_force if with_what[name] != in_force[name]} == {"numpy"}


@_FIXED
def test_all_libraries_compute_for_the_target_unless_they_were_loaded_before() -> None:
    assert arithmetic.strays() == []
    code = "import numpy\nfrom pliant.arithmetic import strays\nprint(strays())"
    assert "Nehalem x 1" in _answer(code, _LESSER)
