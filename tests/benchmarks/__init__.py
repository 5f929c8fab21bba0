"""What `scripts/bench` measures.  Machines are noisy: ratios within one run are what counts."""
