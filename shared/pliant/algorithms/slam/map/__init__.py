"""What a map consists of: landmarks, keyframes, links."""
