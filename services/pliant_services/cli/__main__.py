"""``python -m pliant_services.cli``: the same as ``pliant``."""

from pliant_services.cli import main

main()
