"""One arithmetic under all results: x86-64-v3, which is a processor with AVX2, and one thread.

LLVM, BLAS, numpy and OpenCV choose their code by what the processor can do, and each choice rounds
in its own way; so do the threads of a BLAS.  They choose when they are loaded, and by their
environment.  It is set here, by the first import of anything of Pliant's, and handed down to the
processes that it starts.  If numpy or OpenCV were imported before, they have chosen already:
``in_force``.
"""

import hashlib
import os
import platform
import sys
from contextlib import suppress
from typing import Any

TARGET = "x86-64-v3"

_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
_X86_64_V3 = {
    "NUMBA_CPU_NAME": TARGET,
    "NUMBA_CPU_FEATURES": "",  # those of the name, not the processor's
    "NUMBA_DISABLE_INTEL_SVML": "1",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "OPENCV_IPP": "avx2",
}
VARIABLES = (*_ONE_THREAD, *_X86_64_V3, "OPENCV_CPU_DISABLE")
"""The variables of the environment that are set for this process and those that it starts."""

_FLAGS_OF_V3 = {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"}
_FLAGS_OF_V4 = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}


def fix() -> None:
    """Limit the libraries to one thread, and to the target if the processor supports it.

    Where numpy is loaded its BLAS gets one thread; what it computes for can no longer be changed.
    """
    os.environ.update(_ONE_THREAD)
    flags = _processor_flags()
    if flags >= _FLAGS_OF_V3:
        os.environ.pop("NPY_ENABLE_CPU_FEATURES", None)  # numpy takes one of the two
        os.environ.pop("OPENCV_CPU_DISABLE", None)
        os.environ.update(_X86_64_V3)
        if flags >= _FLAGS_OF_V4:  # else OpenCV complains that there is nothing to disable
            os.environ["OPENCV_CPU_DISABLE"] = "AVX512-SKX"
    if "numpy" in sys.modules:
        import threadpoolctl

        threadpoolctl.threadpool_limits(1, user_api="blas")


def target() -> str:
    """The target of the arithmetic: TARGET, or else this kind of machine and processor."""
    if _processor_flags() >= _FLAGS_OF_V3:
        return TARGET
    import llvmlite.binding as llvm

    return f"{platform.machine()} {llvm.get_host_cpu_name()}"


def in_force() -> dict[str, str]:
    """The instruction sets that the libraries of this process use: loads and queries them."""
    import cv2
    import numpy
    import threadpoolctl
    from numba.core.registry import cpu_target

    codegen: Any = cpu_target.target_context.codegen()  # type: ignore[attr-defined]
    *_, cpu, features = codegen.magic_tuple()
    extensions: Any = numpy.show_config("dicts")["SIMD Extensions"]  # type: ignore[index]
    pools = [pool for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    blas = {f"{pool.get('architecture')} x {pool['num_threads']}" for pool in pools}
    opencv = [word[1:] for word in cv2.getCPUFeaturesLine().split() if word[0] == "*"]
    return {
        "llvm": f"{cpu} {hashlib.sha256(features.encode()).hexdigest()[:8]}" if features else cpu,
        "numpy": " ".join(extensions.get("found", ())),
        "blas": ", ".join(sorted(blas)),
        "opencv": " ".join(word for word in opencv if not word.endswith("?")),
        "ipp": cv2.ipp.getIppVersion(),
    }


def strays() -> list[str]:
    """The libraries of this process that do not compute for the target, where it is fixed."""
    if target() != TARGET:
        return []
    found = in_force()
    good = {"llvm": TARGET, "numpy": "X86_V3", "blas": "Haswell x 1"}
    wrong = [name for name in good if found[name] != good[name]]
    wrong += [name for name in ("opencv", "ipp") if "512" in found[name]]
    return [f"{name} with {found[name]}" for name in wrong]


def _processor_flags() -> set[str]:
    """The features of an x86-64 processor, in Linux' words; none for others."""
    if platform.machine() == "x86_64":
        with suppress(OSError), open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:
            for line in file:
                if line.startswith("flags"):
                    return set(line.partition(":")[2].split())
    return set()
