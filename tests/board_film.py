"""Images of a board as a known lens sees it: flat shading, noise, and every pixel of its area."""

from collections.abc import Iterator
from functools import cache
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.board_calibration import Board
from pliant.algorithms.rectification import Lens, undistort

SQUARE_PX = 40
_FINER = 2  # samples across a pixel
LENS = Lens(
    model="pinhole-radtan",
    width=640,
    height=480,
    fx=560.0,
    fy=558.0,
    cx=325.3,
    cy=236.8,
    coefficients=(-0.21, 0.06, 8e-4, -6e-4, 0.0),
)
FISHEYE = Lens(
    model="fisheye",
    width=640,
    height=480,
    fx=330.0,
    fy=329.0,
    cx=325.3,
    cy=236.8,
    coefficients=(0.02, -0.008, 0.002, -0.0005),
)


def texture(board: Board) -> np.ndarray[Any, Any]:
    """The board with a white border of one square."""
    size = (board.columns * SQUARE_PX, board.rows * SQUARE_PX)
    if board.kind == "charuco":
        image = board.aruco().generateImage(size, marginSize=0, borderBits=1)
    else:
        odd = np.indices((board.rows, board.columns)).sum(axis=0) % 2
        image = np.kron(odd * 255, np.ones((SQUARE_PX, SQUARE_PX))).astype(np.uint8)
    return cv2.copyMakeBorder(image, *[SQUARE_PX] * 4, cv2.BORDER_CONSTANT, value=255)


def film(
    board: Board, lens: Lens, count: int, *, tilt_deg: float = 35.0, seed: int = 0
) -> Iterator[np.ndarray[Any, Any]]:
    """(H, W) grey images; the board moves through the image and tilts by up to so much."""
    random = np.random.default_rng(seed)
    surface = texture(board)
    rays = _rays(lens)
    middle = np.array([board.columns, board.rows]) / 2.0
    reach = np.array([lens.width / lens.fx, lens.height / lens.fy])
    for _ in range(count):
        turn, _ = cv2.Rodrigues(np.radians(random.uniform(-tilt_deg, tilt_deg, 3)))
        distance = random.uniform(1.3, 2.6) * max(board.columns / reach[0], board.rows / reach[1])
        place = np.append(random.uniform(-0.3, 0.3, 2) * reach * distance, distance)
        # From a pixel's ray to the board: the inverse of the homography [r1 r2 t].
        H = np.linalg.inv(np.column_stack([turn[:, 0], turn[:, 1], place - turn[:, :2] @ middle]))
        on_board = rays @ H[:, :2].T + H[:, 2]
        points = on_board[..., :2] / on_board[..., 2:]
        where = ((points + 1.0) * SQUARE_PX - 0.5).astype(np.float32)
        fine = cv2.remap(
            surface, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=(128.0,)
        )
        image = cv2.resize(fine, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        noisy = 0.8 * image + 20.0 + random.normal(0.0, 2.0, image.shape)
        yield np.clip(noisy, 0, 255).astype(np.uint8)


@cache
def _rays(lens: Lens) -> np.ndarray[Any, Any]:
    u = (np.arange(lens.width * _FINER) + 0.5) / _FINER - 0.5
    v = (np.arange(lens.height * _FINER) + 0.5) / _FINER - 0.5
    plane = np.stack(np.meshgrid((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy), axis=-1)
    return np.nan_to_num(undistort(plane, lens), nan=1e6)
