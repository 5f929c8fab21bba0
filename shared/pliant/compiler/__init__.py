"""How kernels are compiled, kept on disk and linked.

No kernel calls BLAS: where scipy is installed, numba would import it all the same, for a quarter of
a second in every process.
"""

import numba.np.linalg


def _no_blas() -> None:
    raise ImportError("kernels do without BLAS: scipy is none of Pliant's dependencies")


numba.np.linalg.ensure_blas = _no_blas
