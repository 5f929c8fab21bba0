"""Which services a session has, by name alone: help pages need no topics, which load numpy."""

PROFILES: dict[str, tuple[str, ...]] = {
    "rigid": ("ingest", "tracking", "bundle_adjustment", "meshing", "recorder"),
    "points": ("ingest", "tracking", "bundle_adjustment", "recorder"),
    "deformable": ("ingest", "surfels", "recorder"),
    "deformable-map": (
        *("ingest", "tracking", "bundle_adjustment", "deformable_mapping", "surfels", "recorder"),
    ),
}
"""``deformable`` becomes ``deformable-map`` where surfels get their depth from Pliant's own map."""
NAMES = tuple(dict.fromkeys(name for fleet in PROFILES.values() for name in fleet))
