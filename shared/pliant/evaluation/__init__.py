"""How good a result is: trajectories, tracks and maps against the truth, and the reports of it."""
