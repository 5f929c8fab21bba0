"""MCAP recordings: writing them so that nothing is lost, and reading them back."""
