"""What `scripts/bench` measures.  Machines are noisy: ratios within one run are what counts."""

import pliant  # noqa: F401  (fixes the arithmetic before any module loads numpy)
