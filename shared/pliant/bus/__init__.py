"""How services exchange messages: one protocol, one bus over Zenoh, one that replays."""
