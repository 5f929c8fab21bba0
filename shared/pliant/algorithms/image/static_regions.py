"""Regions that stay the same while the scene moves: borders, overlays, parts of the vehicle.

A frame counts as evidence only if most of the texture has moved since the last frame that counted.
So a still camera gives none.  What remains in such frames at the same place is not part of the
scene:

    border     a dark, flat region along the image's edge with a sharp outline that does not move:
               the outside of an endoscope's circle, bars above and below a film
    overlay    texture in both directions that does not move: text, a logo, a dashboard, a bonnet

The outline matters most: a tracker finds extrema on it that contradict the motion of the camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, U8, BoolArray
from pliant.algorithms.image.sharpness import resized

_SIDE_PX = 320
"""Along the longer side of the images that are compared: averages over pixels hide their noise."""

_BLOCK_PX = 16
_MOVED = 0.5
"""A block has moved where gradients changed by this share of what unrelated ones would, and the
image where this share of its blocks with texture has."""

_DECISIONS = (16, 32, 64, 128, 256)
"""Numbers of counted frames after which the mask is decided, then again: later ones know more."""

_INTERVAL_S = 0.2
"""Frames that count are at least so far apart: in an instant a straight road looks static."""

_EDGE = 4.0
"""Grey levels per pixel: a gradient is an edge from here on, and a block with that has texture."""

_SAME_DIRECTION = 0.75
_SAME_EDGE = 0.85
"""An outline keeps its direction, an overlay its whole gradient: the length of the mean over the
mean length, and the energy of the mean over the mean energy.  N unrelated ones leave 1/sqrt(N) and
1/N."""

_DARK = 40.0
_STEADY = 6.0
"""Grey levels: a border is darker than this, and its standard deviation over time smaller."""

_OUTLINED = 0.8
"""Share of a border's outline that is an edge which does not move."""

_BOTH_WAYS = 0.1
"""Ratio of the eigenvalues of an overlay's structure tensor; that of a straight line, such as the
horizon, is 0."""

_IN_MOTION = 0.5
"""Share of an overlay's surroundings that changes by more than noise.  What is as far away as the
horizon stands still as well, and so does all around it."""

_MOST_OVERLAID = 0.5
"""Maximum share of the image that overlays cover."""

_ROUND = 0.01
_ROUND_SHARE = 0.8
_SECTORS = 36
_FITS = 3
"""A circle: this share of the outline is so round, as a share of the longer side, in at least half
of that many sectors.  It is fitted so often, without what is far from it."""

_STRAIGHT = 0.97
"""Bars leave this share of the rectangle around what they leave."""

_MARGIN = 0.01
"""Margin of the mask beyond the detected region, share of the longer side."""

_JOINED = 0.02
"""Share of the longer side: letters closer than this are masked together."""


@dataclass(frozen=True)
class StaticMask:
    """used: (H, W) of the requested size.   shares: of the image, of each detected kind: "circle",
    "bars", "border" (of another shape), "overlay".
    """

    used: BoolArray
    shares: dict[str, float]


class StaticRegions:
    """Collects evidence from frames, one after the other.  Deterministic."""

    def __init__(self) -> None:
        self._counted = 0
        self._last: F32 | None = None
        self._sums: F32 = np.zeros((0, 0, 6), np.float32)
        self._counted_ns = 0
        self.decisions = 0
        self._overlay: BoolArray | None = None

    def is_wanted(self, stamp_ns: int) -> bool:
        """Whether a frame of this time could count."""
        enough = self._counted >= _DECISIONS[-1]
        return not enough and (
            self._counted == 0 or stamp_ns - self._counted_ns >= 1e9 * _INTERVAL_S
        )

    def add(self, grey: U8, stamp_ns: int) -> bool:
        """Take in a frame (H, W) that is wanted; whether it is time to decide.

        stamp_ns: increasing.
        """
        image = resized(grey, _SIDE_PX).astype(np.float32)
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)
        slopes = [cv2.Scharr(image, cv2.CV_32F, *d) / 32.0 for d in ((1, 0), (0, 1))]
        gradient = np.dstack(slopes).astype(np.float32)
        if self._last is None or self._last.shape != gradient.shape:
            self._sums, self._counted = np.zeros((*image.shape, 6), np.float32), 0
        elif not _has_moved(self._last, gradient):
            return False
        self._last, self._counted_ns = gradient, stamp_ns
        length = np.sqrt(_squares(gradient))[..., None]
        new = np.dstack([image, image**2, gradient, length, length**2])
        self._sums = (self._sums + new).astype(np.float32)
        self._counted += 1
        return self._counted in _DECISIONS

    def decide(self, size: tuple[int, int]) -> StaticMask | None:
        """The static area, for images of a size (width, height); None: nothing.  Called once
        whenever it is time: an overlay is one that was found the last time as well."""
        means = (self._sums / self._counted).astype(np.float32)
        self.decisions += 1
        shape, region = _border(means)
        border = _grown(region, _MARGIN)
        before, self._overlay = self._overlay, _grown(_overlay(means), _MARGIN)
        overlay = np.zeros_like(border) if before is None else before & self._overlay & ~border
        covered = border | overlay
        shares = {shape: float(border.mean()), "overlay": float(overlay.mean())}
        shares = {kind: share for kind, share in shares.items() if share > 0.0}
        if not shares:
            return None
        whole = cv2.resize(255 * covered.astype(np.uint8), size, interpolation=cv2.INTER_LINEAR)
        return StaticMask(np.asarray(whole) < 128, shares)


def _has_moved(before: F32, now: F32) -> bool:
    """Whether most of the blocks that have texture differ as unrelated ones would."""
    changed = _per_block(_squares(now - before))
    energy = _per_block(_squares(now)), _per_block(_squares(before))
    textured = np.maximum(*energy) > _EDGE**2
    moved = changed > _MOVED * (energy[0] + energy[1])
    return bool(np.count_nonzero(moved & textured) > _MOVED * max(1, np.count_nonzero(textured)))


def _squares(vectors: F32) -> F32:
    """Squared lengths.  numpy sums over an axis of two in ten times the time."""
    x, y = vectors[..., 0], vectors[..., 1]
    return np.asarray(x * x + y * y, np.float32)


def _per_block(values: F32) -> F32:
    """Means over blocks; what does not fill one is left out."""
    height, width = (n // _BLOCK_PX for n in values.shape)
    cut = values[: height * _BLOCK_PX, : width * _BLOCK_PX]
    return cut.reshape(height, _BLOCK_PX, width, _BLOCK_PX).mean(axis=(1, 3))


def _border(means: F32) -> tuple[str, BoolArray]:
    """Dark, flat regions along the image's edge, with their outlines, which do not move."""
    steady = (_deviation(means) < _STEADY) & (means[..., 0] < _DARK)
    length = np.sqrt(_squares(means[..., 2:4]))
    outline = (length > _EDGE) & (length > _SAME_DIRECTION * means[..., 4])
    near = _grown(outline, _MARGIN)
    _count, labels = cv2.connectedComponents((steady & ~outline).astype(np.uint8), connectivity=4)
    frame = np.ones(steady.shape, np.bool_)
    frame[1:-1, 1:-1] = False
    found, touching = np.zeros(steady.shape, np.bool_), np.zeros(steady.shape, np.bool_)
    for label in np.unique(labels[frame & (labels > 0)]):
        region = labels == label
        touching |= region
        around = _dilated(region, 1) & ~region
        if np.count_nonzero(around & near) > _OUTLINED * np.count_nonzero(around):
            found |= region
    circle = _outside_circle(outline & _grown(touching, _MARGIN), steady)
    if circle is not None:
        return "circle", circle
    # The outline is as wide as its blur.
    for _ in range(max(1, round(_MARGIN * max(found.shape)))):
        found = found | (_dilated(found, 1) & outline)
    used = np.argwhere(~found)
    height, width = np.ptp(used, axis=0) + 1
    return "bars" if len(used) > _STRAIGHT * width * height else "border", found


def _outside_circle(outline: BoolArray, steady: BoolArray) -> BoolArray | None:
    """The area outside of the outline, if that is a circle and all outside is steady.

    A dark part of the scene that stays beside the border for a while opens the outline, not the
    circle.
    """
    y, x = np.nonzero(outline)
    limit = _ROUND * max(outline.shape)
    used = np.ones(len(x), np.bool_)
    a, b, radius, off = 0.0, 0.0, 0.0, np.zeros(len(x))
    for _ in range(_FITS):
        if np.count_nonzero(used) < max(outline.shape) // 2:
            return None
        # x^2 + y^2 = 2 a x + 2 b y + c
        A = np.column_stack([2.0 * x, 2.0 * y, np.ones(len(x))])[used]
        (a, b, c), *_ = np.linalg.lstsq(A, np.square([x, y]).sum(axis=0)[used].astype(np.float64))
        radius = np.sqrt(max(c + a * a + b * b, 0.0))
        off = np.abs(np.hypot(x - a, y - b) - radius)
        used = off < max(limit, 2.0 * np.median(off))
    if np.count_nonzero(off < limit) < _ROUND_SHARE * len(x):
        return None
    rows, columns = np.mgrid[: outline.shape[0], : outline.shape[1]]
    distance = np.hypot(columns - a, rows - b)
    outside = distance > radius + limit
    turns = np.arctan2(y - b, x - a)[off < limit]
    seen = len(np.unique(np.floor(turns * _SECTORS / (2.0 * np.pi))))
    if seen < _SECTORS // 2 or not outside.any() or steady[outside].mean() < _ROUND_SHARE:
        return None
    return distance > radius - limit


def _overlay(means: F32) -> BoolArray:
    """Texture that does not move where all around it does."""
    deviation, gradient = _deviation(means), means[..., 2:4]
    energy = _squares(gradient)
    still = (energy > _EDGE**2) & (energy > _SAME_EDGE * means[..., 5])
    side = max(still.shape)
    joined = _dilated(still, round(_JOINED * side))
    count, labels = cv2.connectedComponents(joined.astype(np.uint8))
    found = np.zeros(still.shape, np.bool_)
    for label in range(1, count):
        region = (labels == label) & still
        near = _dilated(region, 2)
        around = _dilated(region, round(_JOINED * side) + 2) & ~near
        tensor = gradient[region].T @ gradient[region]
        low, high = np.linalg.eigvalsh(tensor)
        moving = np.count_nonzero(around & (deviation > _STEADY))
        if low > _BOTH_WAYS * high and moving > _IN_MOTION * np.count_nonzero(around):
            found |= region
    return found if found.mean() < _MOST_OVERLAID else np.zeros_like(found)


def _deviation(means: F32) -> F32:
    """Standard deviation of each pixel over time."""
    return np.sqrt(np.maximum(means[..., 1] - means[..., 0] ** 2, 0.0))


def _dilated(region: BoolArray, reach: int) -> BoolArray:
    side = 2 * reach + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(region.astype(np.uint8), kernel)) > 0


def _grown(region: BoolArray, share: float) -> BoolArray:
    """A region with a margin, a share of the image's longer side."""
    return _dilated(region, max(1, round(share * max(region.shape))))
