"""``scripts/bench``: measure, and compare within one run."""

from importlib import import_module

from benchmarks.commands.app import app
from pliant_services.cli import main

SUBJECTS = ("pages", "places", "comparisons", "recording", "parts", "running", "surfaces")
"""In the order of the help page: a command is registered when its file is imported."""

for subject in SUBJECTS:
    import_module(f"benchmarks.commands.{subject}")

if __name__ == "__main__":
    main(app)
