"""The commands of ``scripts/bench``, a file per subject; what measures is imported inside them."""
