"""MCAP recordings: written without loss, and read back."""
