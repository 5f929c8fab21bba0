"""A texture from views, on planes known exactly, and the files that it comes in."""

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.texturing import (
    TexelColours,
    cut_apart,
    find_texels,
    make_atlas,
    patches,
)
from pliant.formats.textured import TexturedMesh, write_glb, write_obj

CAMERA = PinholeCamera(width=200, height=160, fx=150.0, fy=150.0, cx=99.5, cy=79.5)
SIZE = 64
# Anticlockwise for a camera at the origin that looks along z.
CORNERS = np.array([[-1, -1, 4], [1, -1, 4], [1, 1, 4], [-1, 1, 4]], np.float32)
TRIANGLES = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
UVS = (CORNERS[:, :2] + 1.0) / 2.0
GREY = 77


def shown(points: F32, triangles: I32) -> Any:
    """The texture of the square of CORNERS, which come first; a view whose red is u, green v."""
    texels = find_texels(UVS[TRIANGLES], SIZE)
    colours = TexelColours(texels, points, triangles)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    image = np.stack([u, v, np.full_like(u, 200)], axis=2).astype(np.uint8)
    colours.add(image, colours.depths(CAMERA, np.eye(4)), CAMERA, np.eye(4))
    return texels, colours.texture(np.full((len(texels.triangles), 3), GREY, np.uint8))


def test_a_texel_has_the_colour_of_its_pixel() -> None:
    texels, texture = shown(CORNERS, TRIANGLES)
    assert texels.inside.all()
    places = texels.interpolate(CORNERS[TRIANGLES]).reshape(SIZE, SIZE, 3)
    # The middle of texel (0, 0) is half a texel from the corner of the square.
    np.testing.assert_allclose(places[0, 0, :2], -1.0 + 1.0 / SIZE, atol=1e-5)
    seen = CAMERA.project(places.reshape(-1, 3)).reshape(SIZE, SIZE, 2)
    np.testing.assert_allclose(texture[..., :2], seen, atol=0.51)
    assert (texture[..., 2] == 200).all()


def test_what_hides_a_texel_gives_it_no_colour() -> None:
    before = CORNERS * np.float32(0.3) + np.array([0.0, 0.0, 0.8], np.float32)  # at 2
    points = np.concatenate([CORNERS, before])
    _, texture = shown(points, np.concatenate([TRIANGLES, TRIANGLES + 4]))
    assert (texture[SIZE // 2, SIZE // 2] == GREY).all()
    assert texture[2, 2, 2] == texture[-3, -3, 2] == 200
    turned = TRIANGLES[:, ::-1].copy()
    texels = find_texels(UVS[turned], SIZE)
    colours = TexelColours(texels, CORNERS, turned)
    depths = colours.depths(CAMERA, np.eye(4))
    colours.add(np.full((160, 200, 3), 9, np.uint8), depths, CAMERA, np.eye(4))
    assert (colours.texture(np.full((SIZE**2, 3), GREY, np.uint8)) == GREY).all()


def test_what_a_mask_covers_gives_a_texel_no_colour() -> None:
    texels = find_texels(UVS[TRIANGLES], SIZE)
    colours = TexelColours(texels, CORNERS, TRIANGLES)
    used = np.ones((CAMERA.height, CAMERA.width), np.bool_)
    used[:, : CAMERA.width // 2] = False
    depths = colours.depths(CAMERA, np.eye(4), used)
    colours.add(np.full((160, 200, 3), 9, np.uint8), depths, CAMERA, np.eye(4))
    texture = colours.texture(np.full((SIZE**2, 3), GREY, np.uint8))
    assert (texture[:, : SIZE // 2 - 2] == GREY).all()
    assert (texture[2:-2, SIZE // 2 + 2 : -2] == 9).all()


def colours_of(*views: tuple[int, float, float]) -> Any:
    """The texture of the square by views from its front, each of one grey, a gain, a sharpness."""
    texels = find_texels(UVS[TRIANGLES], SIZE)
    colours = TexelColours(texels, CORNERS, TRIANGLES)
    depths = colours.depths(CAMERA, np.eye(4))
    for grey, gain, sharpness in views:
        image = np.full((CAMERA.height, CAMERA.width, 3), grey, np.uint8)
        gains = np.full(3, gain)
        colours.add(image, depths, CAMERA, np.eye(4), gain=gains, sharpness=sharpness)
    return colours.texture(np.full((len(texels.triangles), 3), GREY, np.uint8))


def test_gains_divide_colours_and_the_sharpest_view_counts_most() -> None:
    assert (colours_of((80, 0.8, 1.0), (120, 1.2, 1.0)) == 100).all()
    assert (colours_of((60, 1.0, 1.0), (120, 1.0, 1.0)) == 90).all()
    assert (colours_of((60, 1.0, 0.2), (120, 1.0, 0.6)) >= 119).all()


def test_what_a_gain_would_saturate_darkens_the_texture() -> None:
    assert (colours_of((200, 0.5, 1.0)) == 255).all()
    texels = find_texels(UVS[TRIANGLES], SIZE)
    colours = TexelColours(texels, CORNERS, TRIANGLES)
    image = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    image[:, CAMERA.width // 2 :] = 200
    colours.add(image, colours.depths(CAMERA, np.eye(4)), CAMERA, np.eye(4), gain=np.full(3, 0.5))
    texture = colours.texture(np.full((len(texels.triangles), 3), GREY, np.uint8))
    assert (texture[:, : SIZE // 2 - 2] == 115).all()  # not 180: of 400 comes 255
    assert (texture[:, SIZE // 2 + 2 :] == 255).all()


def test_texels_off_the_mesh_have_the_colour_of_the_nearest_on_it() -> None:
    uvs = (UVS[TRIANGLES] * 0.5 + 0.25).astype(np.float32)
    texels = find_texels(uvs, SIZE)
    assert 0.2 < texels.inside.mean() < 0.3
    colours = np.tile(np.arange(len(texels.triangles))[:, None] % 251, 3).astype(np.uint8)
    texture = TexelColours(texels, CORNERS, TRIANGLES).texture(colours)
    first = SIZE // 4
    assert (texture[:first, :first] == texture[first, first]).all()


def test_a_cut_mesh_is_a_manifold_in_each_patch() -> None:
    # Two tetrahedra that share an edge, and a third that touches them at one vertex.
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    mesh = np.concatenate([faces, np.array([0, 1, 4, 5])[faces], np.array([0, 6, 7, 8])[faces]])
    cut, source = cut_apart(mesh.astype(np.int32), np.zeros(12, np.int64))
    np.testing.assert_array_equal(source[cut], mesh)
    assert len(source) == 12
    assert len({frozenset(rows) for rows in cut.reshape(3, -1).tolist()}) == 3
    apart, source = cut_apart(mesh.astype(np.int32), np.arange(12))
    np.testing.assert_array_equal(source[apart], mesh)
    assert len(source) == 36
    points = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    assert len(patches(points[mesh])) == 12
    flat = np.concatenate([CORNERS[TRIANGLES], CORNERS[TRIANGLES][:, ::-1]])
    assert len(np.unique(patches(flat)[:2])) <= 2
    assert not set(patches(flat)[:2]) & set(patches(flat)[2:])


def test_an_atlas_keeps_pieces_apart_at_one_scale() -> None:
    # A box, and far from it a square of which the texture has as many texels for its size.
    box = np.array([[x, y, z] for z in (0, 2) for y in (0, 2) for x in (0, 2)], np.float32)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    points = np.concatenate([box, CORNERS + np.array([24.0, 0.0, 0.0], np.float32)])
    triangles = np.concatenate([faces, TRIANGLES + 8]).astype(np.int32)
    corners = points[triangles]
    cut, source = cut_apart(triangles, patches(corners))
    assert len(source) == 7 * 4
    uvs = make_atlas(corners, cut, 256)
    assert uvs.min() > 0.0
    assert uvs.max() < 1.0
    texels = find_texels(uvs, 256)
    area = np.bincount(texels.triangles, minlength=14)
    assert area.min() > 0.95 * area.max()  # they are of one size
    assert area.sum() > 0.5 * 256**2
    assert len(np.unique(texels.triangles)) == 14
    sides = np.linalg.norm(uvs - np.roll(uvs, 1, axis=1), axis=2)
    scales = sides / np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    np.testing.assert_allclose(scales, scales[0, 0], rtol=1e-3)
    pieces = uvs.reshape(7, 6, 2)
    for a in range(7):
        for b in range(a):
            apart = np.maximum(
                pieces[a].min(axis=0) - pieces[b].max(axis=0),
                pieces[b].min(axis=0) - pieces[a].max(axis=0),
            )
            assert apart.max() >= 4 / 256 - 1e-6


@pytest.fixture
def mesh() -> TexturedMesh:
    texture = np.random.default_rng(0).integers(0, 255, (8, 8, 3)).astype(np.uint8)
    normals = np.tile(np.array([0, 0, -1], np.float32), (4, 1))
    return TexturedMesh(
        positions=CORNERS, normals=normals, uvs=UVS, triangles=TRIANGLES, texture=texture
    )


def test_a_glb_holds_all_of_the_mesh(mesh: TexturedMesh, tmp_path: Path) -> None:
    path = tmp_path / "mesh.glb"
    write_glb(path, mesh)
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    body_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    body = data[28 + size :]
    assert (kind, body_size) == (b"BIN\0", len(body))
    assert document["buffers"] == [{"byteLength": len(body)}]

    def array(index: int, dtype: str, columns: int) -> Any:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        values = np.frombuffer(body, dtype, view["byteLength"] // 4, view["byteOffset"])
        assert len(values) == accessor["count"] * columns
        return values.reshape(-1, columns)

    (primitive,) = document["meshes"][0]["primitives"]
    at = primitive["attributes"]
    np.testing.assert_array_equal(array(at["POSITION"], "<f4", 3), mesh.positions)
    np.testing.assert_array_equal(array(at["NORMAL"], "<f4", 3), mesh.normals)
    np.testing.assert_array_equal(array(at["TEXCOORD_0"], "<f4", 2), mesh.uvs)
    np.testing.assert_array_equal(
        array(primitive["indices"], "<u4", 1).reshape(-1, 3), mesh.triangles
    )
    bounds = document["accessors"][at["POSITION"]]
    assert (bounds["min"], bounds["max"]) == ([-1.0, -1.0, 4.0], [1.0, 1.0, 4.0])
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    png = np.frombuffer(body, np.uint8, view["byteLength"], view["byteOffset"])
    np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_COLOR_RGB), mesh.texture)


def test_an_obj_has_v_upwards_and_its_texture_beside(mesh: TexturedMesh, tmp_path: Path) -> None:
    write_obj(tmp_path, mesh)
    lines = [line.split() for line in (tmp_path / "mesh.obj").read_text().splitlines()]
    named = {name: [line[1:] for line in lines if line[0] == name] for name in ("v", "vt", "f")}
    np.testing.assert_array_equal(np.array(named["v"], float), mesh.positions)
    np.testing.assert_array_equal(np.array(named["vt"], float)[:, 1], 1.0 - mesh.uvs[:, 1])
    assert named["f"][0] == ["1/1/1", "3/3/3", "2/2/2"]
    assert "map_Kd mesh.png" in (tmp_path / "mesh.mtl").read_text()
    read = cv2.imread(str(tmp_path / "mesh.png"), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(read, mesh.texture)
