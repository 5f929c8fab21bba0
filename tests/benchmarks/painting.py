"""The textures of a small scene, in this process."""

from pliant.rendering.face_textures import FaceTexture, make_face
from pliant.rendering.render import SceneGeometry


def paint_faces(geometry: SceneGeometry) -> list[FaceTexture]:
    """Those of all faces, one after the other."""
    return [make_face(geometry.scene, geometry.solids, i) for i in range(geometry.n_faces)]
