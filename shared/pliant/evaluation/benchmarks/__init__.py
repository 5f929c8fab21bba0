"""Benchmarks against other solvers: each a function that returns rows, and one that draws them."""
