"""What ``import pliant`` gives: runs, their results, and mapping image by image."""
