"""Tracks drawn on their images: a picture, or a video with tails."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, I64, U8, BoolArray
from pliant.algorithms.tracks import COASTING, FrameTracks
from pliant.pictures.movie import write_image, write_movie

TAIL = 10
"""Positions before the present one that a tail shows."""
OLDEST = 300
"""Age in frames at which the colour of a track stops changing."""

_COLOURS = 24
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_BAR_PX = 30
_TEXT = (235, 235, 235)


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

        Colour is age: blue is new, orange is old.  Filled: on a curvature extremum of this frame;
        hollow: carried by its patch.  Tracks that are not in the map (where that is known) are
        drawn small.
        """
        self.follow(frame.tracks)
        scale = self._scale or (2 if frame.image.shape[1] < 1000 else 1)
        canvas = _enlarge(frame.image, scale)
        mapped = None
        if frame.mapped_ids is not None:
            mapped = np.isin(frame.tracks.ids, frame.mapped_ids)
        self._draw_tails(canvas, frame.tracks, scale)
        self._draw_points(canvas, frame.tracks, mapped, scale)
        return self._with_bar(canvas, frame, mapped)

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
        corners = _fixed_point(self._tails, scale)
        buckets = self._buckets(tracks)
        # Every second position is enough for the eye, and halves the time.
        corners = corners[:, ::2]
        layer = canvas.copy()
        moving = np.abs(corners - corners[:, :1]).max(axis=(1, 2)) >= 1 << _SHIFT
        for bucket, colour in enumerate(self._palette):
            chosen = corners[moving & (buckets == bucket)]
            cv2.polylines(layer, list(chosen), False, colour, 1, cv2.LINE_AA, _SHIFT)
        # Half transparent: thousands of tails would hide the image.
        cv2.addWeighted(layer, 0.45, canvas, 0.55, 0.0, dst=canvas)

    def _draw_points(
        self, canvas: U8, tracks: FrameTracks, mapped: BoolArray | None, scale: int
    ) -> None:
        centres = _fixed_point(tracks.points_px, scale).tolist()
        buckets = self._buckets(tracks).tolist()
        hollow = (tracks.states == COASTING).tolist()
        large = ([True] * len(centres)) if mapped is None else mapped.tolist()
        # OpenCV's smooth discs have a soft rim of a pixel, which counts for more on a small image.
        full, small = (round((a * scale - b) * (1 << _SHIFT)) for a, b in ((1.4, 0.8), (0.7, 0.3)))
        for centre, bucket, ring, big in zip(centres, buckets, hollow, large, strict=True):
            radius = full if big else small
            thickness = 1 if ring else cv2.FILLED
            colour = self._palette[bucket]
            cv2.circle(canvas, centre, radius, colour, thickness, cv2.LINE_AA, _SHIFT)

    def _with_bar(self, canvas: U8, frame: OverlayFrame, mapped: BoolArray | None) -> U8:
        ages = frame.tracks.ages
        words = [f"frame {frame.number}", f"{len(ages)} tracks"]
        if mapped is not None:
            words.append(f"{int(mapped.sum())} in the map")
        words += [frame.status] if frame.status else []
        picture = _with_words(canvas, "   ".join(words))
        bar, width = picture[-_BAR_PX:], picture.shape[1]
        if width >= 600:
            font = cv2.FONT_HERSHEY_SIMPLEX
            ramp = np.repeat(np.array(self._palette, np.uint8)[None], 8, axis=0)
            left = width - 4 * _COLOURS - 44
            bar[11:19, left : left + 4 * _COLOURS] = np.repeat(ramp, 4, axis=1)
            cv2.putText(bar, "age 0", (left - 46, 20), font, 0.42, _TEXT, 1, cv2.LINE_AA)
            end = (left + 4 * _COLOURS + 6, 20)
            cv2.putText(bar, f"{OLDEST}", end, font, 0.42, _TEXT, 1, cv2.LINE_AA)
        return picture


def palette(size: int) -> list[tuple[int, int, int]]:
    """RGB colours from blue (new) over green and yellow to orange (old)."""
    # The ends of the colour map are too dark to see on a dark image.
    steps = np.linspace(40, 200, size).round().astype(np.uint8)[:, None]
    bgr = cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, 0]
    return [(int(r), int(g), int(b)) for b, g, r in bgr]


def draw_marks(
    image: U8, points_px: F32, colours: U8, words: str, *, scale: int | None = None
) -> U8:
    """An image with a small disc at each point and a bar of words under it, (H', W', 3) RGB.

    image: (H, W) grey or (H, W, 3) RGB.    points_px: (N, 2).    colours: (N, 3) RGB.
    """
    scale = scale or (2 if image.shape[1] < 1000 else 1)
    canvas = _enlarge(image, scale)
    centres = _fixed_point(points_px, scale).tolist()
    for centre, colour in zip(centres, colours.tolist(), strict=True):
        cv2.circle(canvas, centre, (2 * scale) << _SHIFT, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)
    return _with_words(canvas, words)


def _with_words(canvas: U8, words: str) -> U8:
    """The picture with a bar of words under it, of even sizes, as video codecs want them."""
    height, width = canvas.shape[:2]
    bar = np.full((_BAR_PX, width, 3), 18, np.uint8)
    cv2.putText(bar, words, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    picture = np.concatenate([canvas, bar])
    return np.ascontiguousarray(picture[: height + _BAR_PX - height % 2, : width - width % 2])


def _enlarge(image: U8, scale: int) -> U8:
    rgb = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    # Darker than it is, so that the tracks stand out.
    dim = np.round(rgb * np.float32(0.75)).astype(np.uint8)
    if scale == 1:
        return dim
    size = (dim.shape[1] * scale, dim.shape[0] * scale)
    return np.asarray(cv2.resize(dim, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _fixed_point(points_px: F32, scale: int) -> "np.ndarray[tuple[int, ...], np.dtype[np.int32]]":
    # Pixel centres are whole numbers in both images: u' = scale * (u + 0.5) - 0.5.
    enlarged = (points_px.astype(np.float64) + 0.5) * scale - 0.5
    return np.round(enlarged * (1 << _SHIFT)).astype(np.int32)


def write_overlay_picture(path: Path, frame: OverlayFrame, *, scale: int | None = None) -> None:
    """Write one frame's tracks on its image; the format follows the suffix (.png, .jpg, ...)."""
    write_image(path, TrackPainter(scale=scale).draw(frame))


def write_overlay_video(
    path: Path, frames: Iterable[OverlayFrame], *, fps: float, scale: int | None = None
) -> int:
    """Write a video of the tracks with their tails (.mp4 or .avi); returns the number of frames.

    frames: in order, all of one size.      scale: as in TrackPainter; 10,000 tracks at twice 640
    columns take about 0.4 MB a frame, at 1 a quarter of that.
    Raises ResultError as ``write_movie`` does.
    """
    painter = TrackPainter(scale=scale)
    return write_movie(path, (painter.draw(frame) for frame in frames), fps=fps)
