"""Messages between processes: their types, the one table of topics, and the codec."""
