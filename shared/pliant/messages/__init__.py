"""What travels between processes: message types, the one table of topics, and the codec."""
