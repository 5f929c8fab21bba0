"""The kinds of export by name, without their code: help pages list them."""

KINDS = {
    "foxglove": "foxglove.mcap",
    "rerun": "rerun.rrd",
    "tum": "trajectory_tum.txt",
    "kitti": "trajectory_kitti.txt",
    "euroc": "trajectory_euroc.csv",
    "gpx": "track.gpx",
    "geojson": "track.geojson",
    "las": "surface.las",
    "ply": "points_longest.ply",
    "colmap": "colmap",
    "nerfstudio": "nerfstudio",
    "splat": "splat",
    "depth": "depth",
    "images": "images",
    "glb": "mesh.glb",
    "obj": "obj",
    "watertight": "mesh_watertight.ply",
    "surface": "surface",
    "animation": "animation.glb",
    "tracks": "tracks",
    "strain": "strain",
    "overlay": "overlay.webm",
    "picture": "picture.png",
    "overview": "overview.webp",
}
"""Kind of export: its default name."""

OF_STILL_SCENES = (
    "gpx",
    "geojson",
    "las",
    "ply",
    "colmap",
    "nerfstudio",
    "splat",
    "depth",
    "glb",
    "obj",
    "watertight",
    "picture",
    "overview",
)
"""Kinds that are made of a map or mesh, which a run of the deformable profile has not."""
OPTIONS = {
    "every": ("surface", "animation", "tracks", "strain"),
    "triangles": ("glb", "obj"),
    "clean": ("glb", "obj"),
    "observed": ("glb", "obj"),
    "crop": ("glb", "obj", "watertight", "ply", "splat", "las"),
}
"""Which kinds have an option."""
