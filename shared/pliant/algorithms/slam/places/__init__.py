"""Place recognition and relocalisation."""
