"""Place recognition, loop closure and relocalisation."""
