"""Advice for the next recording of such a scene."""

import itertools
from collections.abc import Mapping
from typing import Any

from pliant.algorithms.image.exposure import FLAWS
from pliant.messages.types import DROPPED
from pliant.results.calibration import FOUND
from pliant.results.judgement import DOUBTS
from pliant.results.report import broken_images
from pliant.wording import counted

_FEW_TRACKS = 600
_FEW_MAPPED = 0.25
_LONG = 0.02
"""Share of the frames from which on those without a pose are worth a word."""


def advice(report: dict[str, Any], stamps_ns: Mapping[int, int]) -> list[str]:
    """Sentences, the most important first; none where nothing is wrong."""
    sentences: list[str] = []
    segments = report["segments"]
    why = report["last_reason"] or "no frames"
    if not segments and any(flaw.split()[-1] == why.split()[-1] for flaw in FLAWS):
        sentences.append(
            f"No map could start: {why}. Play the video. If it looks right there, convert it "
            "and run the copy."
        )
    elif not segments:
        sentences.append(
            "No map could start. Move the camera sideways by at least a tenth of the distance to "
            "the scene; do not only rotate it. Keep objects at several distances in view, not "
            f"one wall or table alone. The reason was: {why}."
        )
    first_ns = min(stamps_ns.values(), default=0)
    for before, after in itertools.pairwise(segments):
        when_s = 1e-9 * (stamps_ns.get(after["first_frame"], first_ns) - first_ns)
        sentences.append(
            f"Before {when_s:.1f} s the camera was lost, and a new map started "
            f"({before['frames']} and {counted(after['frames'], 'frame')}). Move more slowly "
            "there, with at least 50 % overlap between views a second apart, or return to a "
            "mapped place."
        )
    frames, posed = report["frames"], report["frames_with_pose"]
    missing = frames - posed - len(report["frames_without_pixels"])
    if segments and missing > _LONG * frames:
        sentences.append(
            f"No pose for {counted(missing, 'frame')}: dark, blurred or covered images, or a "
            "sudden jump of the camera. More light makes exposures shorter and images sharper."
        )
    broken = len(broken_images(report["frames_without_pixels"]))
    if broken > _LONG * frames:
        sentences.append(
            f"{counted(broken, 'broken image')}: copy the video again from the camera, or convert "
            "it and run the copy."
        )
    # None were mapped as they came where every frame waited for the map: that is no evidence.
    tracks, mapped = report["median_tracks_per_frame"], report["median_inliers_per_frame"]
    if segments and tracks < _FEW_TRACKS:
        sentences.append(
            f"Only {tracks:.0f} tracks per frame: blank walls, little light or defocus. Keep "
            "textured objects in view, and the focus fixed."
        )
    elif segments and 0 < mapped < _FEW_MAPPED * tracks:
        sentences.append(
            "Few of the tracks became map points: the camera rotated more than it moved, or much "
            "of the scene moves. Walk around objects instead of turning towards them."
        )
    if len(report["doubtful_frames"]) > DOUBTS * posed:
        sentences.append(
            f"{len(report['doubtful_frames'])} poses rely on a small part of the image: something "
            "large moves in front of the camera, or most of the view has no texture. If the "
            "scene deforms, use --profile deformable."
        )
    calibration = report["calibration_verdict"]
    is_mentioned = calibration == report["verdict_reason"] or calibration.startswith(FOUND)
    if calibration and not is_mentioned:
        sentences.append(f"{calibration[:1].upper()}{calibration[1:]}.")
    if report["frames_passed_over"] or any(
        why == DROPPED for why in report["frames_without_pixels"].values()
    ):
        sentences.append(
            "The computer was too slow for the camera. Film first and run the video, or use "
            "smaller images (--max-size) or fewer tracks (--light)."
        )
    return sentences
