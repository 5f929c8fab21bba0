"""Tracks drawn on their images: a picture, or a video with tails."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I64, U8
from pliant.algorithms.tracks import COASTING, FrameTracks
from pliant.pictures.caption import with_caption
from pliant.pictures.movie import write_movie

TAIL = 10
"""Positions before the present one that a tail shows."""
OLDEST = 300
"""Age in frames at which the colour of a track stops changing."""

_COLOURS = 24
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_FINER = 2  # pictures are drawn so much larger, and shrunk: soft edges, and lines below a pixel
_SHARPEST_PX = 1000  # images with fewer columns are shown twice as large

# The share of the picture that the marks of all tracks may cover, whatever their number.
_TRAILS, _DOTS = 0.05, 0.05
_TRAIL_OPACITY = 0.6
_LARGEST_DOT = 0.003
"""Radius, as a share of the width: of few tracks, too, the image stays visible."""
_TRAIL_WIDTH = 0.0009
_BRIGHTNESS, _SATURATION = 0.85, 0.75
"""Brightness and saturation of the image under the marks, so that their colours stand out."""
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True, kw_only=True)
class OverlayFrame:
    """One frame to draw.

    image: (H, W) grey or (H, W, 3) RGB.      number: of the frame.      status: words for the bar
    under the image.      mapped_ids: tracks that are points of the map, increasing; None: unknown.
    """

    image: U8
    tracks: FrameTracks
    number: int
    status: str = ""
    mapped_ids: I64 | None = None


class TrackPainter:
    """Draws one frame after another and remembers the tails in between."""

    def __init__(self, *, scale: int | None = None) -> None:
        """scale: enlarges the image by a whole number; None doubles those below 1000 columns."""
        self._scale = scale
        self._ids: I64 = np.zeros(0, np.int64)
        # (N, TAIL + 1, 2): positions of each track, the present one first.
        self._tails: F32 = np.zeros((0, TAIL + 1, 2), np.float32)
        self._palette = palette(_COLOURS)

    def draw(self, frame: OverlayFrame) -> U8:
        """The picture of a frame, (H', W', 3) RGB, with a bar of words under the image.

        Colour is age: blue is new, orange is old.  Tracks that coast, carried by their patch, and
        those that are not in the map (where that is known) are drawn smaller.
        """
        words = [f"frame {frame.number}", f"{len(frame.tracks.ids):,} tracks"]
        if frame.mapped_ids is not None:
            words.append(f"{np.isin(frame.tracks.ids, frame.mapped_ids).sum():,} in the map")
        words += [frame.status] if frame.status else []
        return with_caption(self.paint(frame), "   ".join(words))

    def paint(self, frame: OverlayFrame) -> U8:
        """The picture without words.

        As many tails as leave the image visible, always of the same tracks; all dots, small.
        """
        self.follow(frame.tracks)
        scale = self._scale or (2 if frame.image.shape[1] < _SHARPEST_PX else 1)
        canvas = _enlarge(_muted(frame.image), scale * _FINER)
        self._draw_tails(canvas, frame.tracks, scale * _FINER)
        self._draw_dots(canvas, frame, scale * _FINER)
        size = (frame.image.shape[1] * scale, frame.image.shape[0] * scale)
        return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), np.uint8)

    def follow(self, tracks: FrameTracks) -> None:
        """Take in the tracks of a frame that is not drawn."""
        tails = np.repeat(tracks.points_px[:, None], TAIL + 1, axis=1)
        if len(self._ids) and len(tracks.ids):
            row = np.minimum(np.searchsorted(self._ids, tracks.ids), len(self._ids) - 1)
            known = self._ids[row] == tracks.ids
            tails[known, 1:] = self._tails[row[known], :-1]
        self._ids, self._tails = tracks.ids, tails

    def _buckets(self, tracks: FrameTracks) -> I64:
        share = np.log1p(tracks.ages) / np.log1p(OLDEST)
        return np.minimum(share * _COLOURS, _COLOURS - 1).astype(np.int64)

    def _draw_tails(self, canvas: U8, tracks: FrameTracks, scale: int) -> None:
        # Every second position is enough for the eye, and halves the time.
        tails = self._tails[:, ::2]
        height, width = canvas.shape[:2]
        thickness = max(1, round(_TRAIL_WIDTH * width))
        lengths = scale * np.linalg.norm(np.diff(tails, axis=1), axis=2).sum(axis=1)
        allowed = _TRAILS * height * width / max(thickness * float(lengths.sum()), 1.0)
        # Spread evenly over the numbers of tracks, so that a track has its tail in every frame.
        chosen = (tracks.ids * _GOLDEN % 1.0 < allowed) & (lengths >= 1.0)
        corners, buckets = _fixed_point(tails[chosen], scale), self._buckets(tracks)[chosen]
        layer = canvas.copy()
        for bucket, colour in enumerate(self._palette):
            lines = list(corners[buckets == bucket])
            cv2.polylines(layer, lines, False, colour, thickness, cv2.LINE_AA, _SHIFT)
        cv2.addWeighted(layer, _TRAIL_OPACITY, canvas, 1.0 - _TRAIL_OPACITY, 0.0, dst=canvas)

    def _draw_dots(self, canvas: U8, frame: OverlayFrame, scale: int) -> None:
        tracks = frame.tracks
        height, width = canvas.shape[:2]
        radius = np.sqrt(_DOTS * height * width / (np.pi * max(len(tracks.ids), 1)))
        radius = min(float(radius), _LARGEST_DOT * width)
        small = tracks.states == COASTING
        if frame.mapped_ids is not None:
            small |= ~np.isin(tracks.ids, frame.mapped_ids)
        # OpenCV's smooth discs have a soft rim of half a pixel.
        full, less = (round(max(r - 0.5, 0.3) * (1 << _SHIFT)) for r in (radius, 0.7 * radius))
        centres = _fixed_point(tracks.points_px, scale).tolist()
        buckets = self._buckets(tracks).tolist()
        for centre, bucket, is_small in zip(centres, buckets, small.tolist(), strict=True):
            cv2.circle(
                canvas, centre, less if is_small else full, self._palette[bucket], cv2.FILLED,
                cv2.LINE_AA, _SHIFT,
            )  # fmt: skip


def palette(size: int) -> list[tuple[int, int, int]]:
    """RGB colours from blue (new) over green and yellow to orange (old)."""
    # The ends of the colour map are too dark to see on a dark image.
    steps = np.linspace(40, 200, size).round().astype(np.uint8)[:, None]
    bgr = cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, 0]
    return [(int(r), int(g), int(b)) for b, g, r in bgr]


def draw_marks(image: U8, points_px: F32, colours: U8, words: str) -> U8:
    """An image with a small disc at each point and a bar of words under it, (H', W', 3) RGB.

    image: (H, W) grey or (H, W, 3) RGB.    points_px: (N, 2).    colours: (N, 3) RGB.
    """
    scale = 2 if image.shape[1] < _SHARPEST_PX else 1
    canvas = _enlarge(_muted(image), scale)
    centres = _fixed_point(points_px, scale).tolist()
    radius = round(_LARGEST_DOT * canvas.shape[1] * (1 << _SHIFT))
    for centre, colour in zip(centres, colours.tolist(), strict=True):
        cv2.circle(canvas, centre, radius, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)
    return with_caption(canvas, words)


def _muted(image: U8) -> U8:
    """(H, W, 3) RGB of a grey or RGB image, darker and less colourful than it is."""
    if image.ndim == 2:
        dark = np.round(image * np.float32(_BRIGHTNESS)).astype(np.uint8)
        return np.repeat(dark[:, :, None], 3, axis=2)
    own, grey = _BRIGHTNESS * _SATURATION, _BRIGHTNESS * (1.0 - _SATURATION)
    mix = own * np.eye(3) + grey * np.array([0.299, 0.587, 0.114])
    return np.asarray(cv2.transform(image, mix), np.uint8)


def _enlarge(image: U8, scale: int) -> U8:
    if scale == 1:
        return image
    size = (image.shape[1] * scale, image.shape[0] * scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _fixed_point(points_px: F32, scale: int) -> "np.ndarray[tuple[int, ...], np.dtype[np.int32]]":
    # Pixel centres are whole numbers in both images: u' = scale * (u + 0.5) - 0.5.
    enlarged = (points_px.astype(np.float64) + 0.5) * scale - 0.5
    return np.round(enlarged * (1 << _SHIFT)).astype(np.int32)


def write_overlay_video(
    path: Path, frames: Iterable[OverlayFrame], *, fps: float, scale: int | None = None
) -> int:
    """Write a video (.webm, .mp4 or .avi) of the tracks with their tails; returns how many frames.

    frames: in order, all of one size.      scale: as in TrackPainter; 10,000 tracks at twice 640
    columns take about 0.4 MB a frame, at 1 a quarter of that.
    Raises ResultError as ``write_movie`` does.
    """
    painter = TrackPainter(scale=scale)
    return write_movie(path, (painter.draw(frame) for frame in frames), fps=fps)
