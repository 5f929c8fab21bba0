"""report.html of a rigid run."""

import base64
import math
from collections.abc import Container
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.geometry import inverse, pose_to_matrix, transform
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.errors import ResultError
from pliant.formats.textured import TexturedMesh
from pliant.pictures.masked import dimmed_by
from pliant.pictures.movie import encode_animation
from pliant.recording.reader import Recording
from pliant.results.mesh_files import mesh_of
from pliant.results.page.advice import advice
from pliant.results.page.chart import BLUE, ORANGE, Line, chart
from pliant.results.page.page import bullets, canvas, ended, fill_page, table_rows
from pliant.results.page.scene import make_scene
from pliant.results.run import Run, SeenKeyframe, seen_by_keyframes
from pliant.results.textured_mesh import textured
from pliant.wording import counted

_TRIANGLES, _TEXELS, _VIEWS = 40_000, 1024, 48
"""Limits of the mesh, of a side of its texture, and of its keyframes: a page has a megabyte."""
_PICTURES = 24
_WIDTH_PX = 480
_FPS = 4.0
_DOT, _DOTS = 1.2, 3000
_SOME_READOUT = 0.05
"""Share of the frame interval: a shorter readout is not distinguishable from none."""


def write_page(
    path: Path, run: Run, final: dict[int, tuple[int, F64]], report: dict[str, Any],
    names: Container[str], *, drawn: str, clip: str,
) -> None:  # fmt: skip
    """Write report.html of a rigid run.  names: of the other files beside it.

    drawn, clip: as ``drawn_map`` and ``clip_of_keyframes`` make them.
    """
    fill_page(
        path, report, names,
        verdict=escape(report["verdict"]),
        reason=escape(report["verdict_reason"]),
        map=drawn,
        clip=clip,
        figures=table_rows(_figures(run, report)),
        chart=_chart(run, report, final),
        advice=bullets("Advice for the next run", advice(report, run.history.stamps_ns)),
    )  # fmt: skip


def drawn_map(run: Run, recording: Recording, final: dict[int, tuple[int, F64]]) -> str:
    """The map that can be turned, its mesh with a texture of keyframes; "" without one."""
    longest = run.history.longest_segment()
    poses = np.array([pose for segment, pose in final.values() if segment == longest])
    if not len(poses):
        return ""
    points, fine = run.history.points_in(longest), mesh_of(run.mesh, longest)
    mesh: TriangleMesh | TexturedMesh | None = fine
    if fine is not None and len(fine.triangles) and run.stream is not None:
        mesh = textured(
            fine, recording, run, run.stream, longest,
            triangles=_TRIANGLES, texels=_TEXELS, views=_VIEWS,
        )  # fmt: skip
    return canvas(
        make_scene(
            points.positions, points.colours, pose_to_matrix(poses), mesh,
            run.history.same_places_in(longest),
        )
    )  # fmt: skip


def clip_of_keyframes(run: Run, recording: Recording) -> str:
    """Keyframes with the points of the map that they see; "" where no images were recorded."""
    longest = run.history.longest_segment()
    keyframes = run.history.keyframes.items()
    chosen = sorted(n for n, k in keyframes if k.segment == longest and k.frame >= 0)
    step = max(1, -(-len(chosen) // _PICTURES))
    wanted = chosen[::step]
    seen = seen_by_keyframes(recording, wanted)
    pictures = [_picture(run, n, seen[n]) for n in wanted if n in seen and seen[n].jpeg]
    if not pictures:
        return ""
    try:
        kind, data = "webp", encode_animation(pictures, fps=_FPS, suffix=".webp", quality=60)
    except ResultError:  # an OpenCV without animations
        _, encoded = cv2.imencode(".jpg", pictures[len(pictures) // 2][..., ::-1])
        kind, data = "jpeg", encoded.tobytes()
    caption = "Keyframes with their map points: near ones red, far ones blue."
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return (
        '<section><h2>Camera images</h2><figure><img alt="Keyframes with the points of the '
        f'map" src="{source}"><figcaption>{caption}</figcaption></figure></section>'
    )


def _picture(run: Run, number: int, seen: SeenKeyframe) -> U8:
    """(H, W, 3) RGB: a keyframe with its points, coloured by how far they are."""
    image = np.asarray(
        cv2.imdecode(np.frombuffer(seen.jpeg, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8
    )
    image = dimmed_by(image, seen.mask)
    scale = min(1.0, _WIDTH_PX / image.shape[1])
    size = round(image.shape[1] * scale), round(image.shape[0] * scale)
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    rows, points = run.history.points_of(seen.point_ids)
    if not len(rows):
        return small  # a run that was cut off: what the keyframe saw is not in its map
    T_camera_world = inverse(pose_to_matrix(run.history.keyframes[number].pose_world_camera))
    depth = transform(T_camera_world, points.positions)[:, 2]
    order = np.argsort(-depth)  # near ones last
    ranks = np.empty(len(depth))
    ranks[order] = np.linspace(0.0, 1.0, len(depth))
    shades = np.round(40.0 + 215.0 * ranks).astype(np.uint8)[:, None]
    palette = np.asarray(cv2.applyColorMap(shades, cv2.COLORMAP_TURBO), np.uint8)
    tints = palette.reshape(-1, 3)[:, ::-1].tolist()
    places = np.round(16.0 * scale * seen.points_px[rows]).astype(np.int64).tolist()
    radius = round(16.0 * _DOT)
    for n in order[:: max(1, len(order) // _DOTS)].tolist():
        cv2.circle(small, places[n], radius, tints[n], cv2.FILLED, cv2.LINE_AA, 4)
    return small


def _figures(run: Run, report: dict[str, Any]) -> list[tuple[str, str]]:
    camera = run.stream.camera if run.stream else None
    mapped = report["median_inliers_per_frame"]
    waited = "every frame waited for the map to start"
    by_gyro = len(report.get("frames_by_gyro", ()))
    rows = [
        (
            "frames",
            f"{report['frames']}, {report['frames_with_pose']} with a pose"
            + (f", {by_gyro} placed by the gyro alone" if by_gyro else ""),
        ),
        *ended(report),
        ("map", f"{counted(report['keyframes'], 'keyframe')}, {report['points']:,} points"),
        (
            "median per frame",
            f"{report['median_tracks_per_frame']:,.0f} tracks, "
            + (f"{mapped:,.0f} of them mapped" if mapped or not report["segments"] else waited),
        ),
    ]
    rows += [
        ("mesh", f"{mesh['triangles']:,} triangles")
        for mesh in report["mesh"]
        if (mesh["segment"], mesh["level"]) == (run.history.longest_segment(), "fine")
    ]
    if camera is not None:
        rows.append(("images", f"{camera.width}x{camera.height}"))
        rows.append(
            (
                "field of view",
                f"{_fov_deg(camera.width, camera.fx):.1f} degrees horizontal",
            )
        )
    correction = report["calibration_correction"]
    if correction is not None and camera is not None:
        found = _fov_deg(camera.width, camera.fx * correction["focal_factor"])
        rows.append(("estimated field of view", f"{found:.1f} degrees"))
        if abs(correction["readout"]) > _SOME_READOUT:
            rows.append(("rolling shutter", f"{correction['readout']:.0%} of the frame interval"))
    rows.append(("scale", _scale(run, report)))
    if report["z_is_up"]:
        rows.append(("vertical", "z is up"))
    return rows


def _scale(run: Run, report: dict[str, Any]) -> str:
    if not report["scale_is_metric"]:
        return "unknown (monocular)"
    if run.scale is None or run.scale.sigma < 0.001:
        return "metres"
    return f"metres, +- {run.scale.sigma:.1%}"


def _fov_deg(width: int, fx: float) -> float:
    return math.degrees(2.0 * math.atan(0.5 * width / fx))


def _chart(run: Run, report: dict[str, Any], final: dict[int, tuple[int, F64]]) -> str:
    """Tracks and mapped inliers over time; frames without a pose are shaded."""
    tracks, inliers = report["tracks_per_frame"], report["inliers_per_frame"]
    frames = sorted(run.tracks)
    if len(frames) < 2:
        return ""
    stamps = run.history.stamps_ns
    seconds = 1e-9 * (max(stamps.values()) - min(stamps.values())) if stamps else 0.0
    most = max(*tracks, *inliers, 1)
    drawn = chart(
        [Line(frames, tracks, BLUE), Line(sorted(run.inliers), inliers, ORANGE)],
        span=(frames[0], frames[-1]),
        top=most,
        labels=("tracks and inliers", f"{most:,}", f"{seconds:.1f} s"),
        shaded=[frame for frame in frames if frame not in final],
    )
    return (
        f"<figure>{drawn}<figcaption>Tracks (blue), and those with a consistent map point "
        "(orange). Shaded: frames without a pose.</figcaption></figure>"
    )
