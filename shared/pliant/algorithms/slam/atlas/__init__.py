"""All segments of the map: recognised, resumed and merged."""
