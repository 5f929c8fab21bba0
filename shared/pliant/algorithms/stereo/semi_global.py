"""Which of several depths each pixel has, so that neighbours agree (semi-global matching).

Hirschmueller 2008, section 2.3: along each of eight straight paths r that end at a pixel p

    L_r(p, d) = C(p, d) + min(L_r(p - r, d), L_r(p - r, d +- 1) + P1, min_k L_r(p - r, k) + P2)
                - min_k L_r(p - r, k),                                             (equation 13)

and the depth of p is that with the least sum of the eight (equation 14).  P2, what a jump costs,
is less where the grey changes along the path, as it does at the borders of things.
"""

from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from pliant.algorithms.arrays import F32, U8, U16, Shape
from pliant.compiler.kernel import kernel

I16: TypeAlias = "np.ndarray[tuple[int, ...], np.dtype[np.int16]]"

_FAR = 16_000
"""Above every path cost: that of depths which there are not."""
_APART = 2
"""Steps: depths nearer than this to the best one are the same surface, and no second one."""


@dataclass(frozen=True)
class Penalties:
    """small: P1, of one step.    jump: P2 where the grey stays.  In units of the costs.

    edge: change of grey by which a jump costs 1 / e of that.
    """

    small: int = 120
    jump: int = 1000
    edge: float = 20.0

    def halved(self) -> "Penalties":
        """For costs of which there are half as many steps to a change of depth."""
        return Penalties(self.small // 2, self.jump // 2, self.edge)

    def of_jumps(self) -> I16:
        """(256,) P2 by the change of grey."""
        falling = self.jump * np.exp(-np.arange(256.0) / self.edge)
        return np.maximum(np.rint(falling), self.small + 1).astype(np.int16)


@dataclass(frozen=True)
class Winners:
    """The best of D depths at each pixel.

    steps: (H, W) its number, between two where a parabola through the three sums has its minimum.
    distinctness: how many times as costly the best one elsewhere is, minus 1; 0: at either end of
    the depths, where no minimum is enclosed.
    """

    steps: Annotated[F32, Shape("H", "W")]
    distinctness: Annotated[F32, Shape("H", "W")]


def best_steps(costs: U8, grey: U8, penalties: Penalties) -> Winners:
    """costs: (H, W, D), D >= 3.    grey: (H, W) the image."""
    sums = path_sums(costs, grey, penalties)
    steps, distinctness = (np.empty(grey.shape, np.float32) for _ in range(2))
    _pick(sums, steps, distinctness)
    return Winners(steps, distinctness)


def path_sums(costs: U8, grey: U8, penalties: Penalties) -> U16:
    """(H, W, D) sums of the path costs of the eight directions."""
    sums = np.zeros(costs.shape, np.int16)
    _walk(costs, grey, np.int16(penalties.small), penalties.of_jumps(), sums, False)
    _walk(costs, grey, np.int16(penalties.small), penalties.of_jumps(), sums, True)
    return sums.view(np.uint16)


@kernel
def _walk(costs: U8, grey: U8, small: np.int16, jumps: I16, sums: I16, backwards: bool) -> None:
    """Four of the eight directions: from the left, and the three from above; or the opposite."""
    height, width, depths = costs.shape
    # Of the row above and of this one: path costs of each direction, between two that are _FAR.
    paths = np.full((2, 3, width + 2, depths + 2), _FAR, np.int16)
    floors = np.zeros((2, 3, width + 2), np.int16)
    beside = np.full((2, depths + 2), _FAR, np.int16)
    step = -1 if backwards else 1
    for k in range(height):
        v = height - 1 - k if backwards else k
        now, before = k % 2, 1 - k % 2
        floor = np.int16(0)
        for i in range(width):
            u = width - 1 - i if backwards else i
            cost, total, here = costs[v, u], sums[v, u], np.int32(grey[v, u])
            if i == 0:
                floor = _begin(cost, total, beside[0])
            else:
                jump = jumps[abs(here - np.int32(grey[v, u - step]))]
                floor = _step(cost, total, beside[(i - 1) % 2], floor, small, jump, beside[i % 2])
            for direction in range(3):
                from_u = u + direction - 1
                path = paths[now, direction, u + 1]
                if k == 0 or from_u < 0 or from_u >= width:
                    floors[now, direction, u + 1] = _begin(cost, total, path)
                    continue
                jump = jumps[abs(here - np.int32(grey[v - step, from_u]))]
                floors[now, direction, u + 1] = _step(
                    cost, total, paths[before, direction, from_u + 1],
                    floors[before, direction, from_u + 1], small, jump, path,
                )  # fmt: skip


@kernel
def _begin(cost: U8, total: I16, path: I16) -> np.int16:
    """A path that begins here; returns its least cost."""
    least = np.int16(_FAR)
    for d in range(len(cost)):
        value = np.int16(cost[d])
        path[d + 1] = value
        total[d] += value
        least = min(least, value)
    return least


@kernel
def _step(
    cost: U8, total: I16, last: I16, floor: np.int16, small: np.int16, jump: np.int16, path: I16
) -> np.int16:
    """Equation 13, from the path costs of the pixel before; returns the least of the new ones.

    floor: the least of the last ones.
    """
    least = np.int16(_FAR)
    nearer, further = last[:-2], last[2:]
    same, new = last[1:-1], path[1:-1]
    bound = np.int16(floor + jump)
    for d in range(len(cost)):
        one = np.int16(min(nearer[d], further[d]) + small)
        value = np.int16(np.int16(cost[d]) + np.int16(min(min(same[d], one), bound) - floor))
        new[d] = value
        total[d] = np.int16(total[d] + value)
        least = min(least, value)
    return least


@kernel
def _pick(sums: U16, steps: F32, distinctness: F32) -> None:
    height, width, depths = sums.shape
    for v in range(height):
        for u in range(width):
            total = sums[v, u]
            best = 0
            for d in range(1, depths):
                if total[d] < total[best]:
                    best = d
            other = np.int64(8 * _FAR)
            for d in range(depths):
                if abs(d - best) > _APART:
                    other = min(other, np.int64(total[d]))
            least = np.int64(total[best])
            steps[v, u], distinctness[v, u] = np.float32(best), np.float32(0.0)
            if best == 0 or best == depths - 1:
                continue
            below, above = np.int64(total[best - 1]), np.int64(total[best + 1])
            bend = below + above - 2 * least
            if bend > 0:
                steps[v, u] = np.float32(best + 0.5 * (below - above) / bend)
            distinctness[v, u] = np.float32((other + 1) / (least + 1) - 1.0)
