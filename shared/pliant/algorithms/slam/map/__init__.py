"""The parts of a map: landmarks, keyframes, links."""
