"""The sensor: exposure, noise, eight bits."""

import math

import numpy as np

from pliant.algorithms.arrays import F32, U8

_EXPOSURE_PERIOD_S = 3.7


def exposure_gain(time_s: float, change: float) -> float:
    """Gain of the exposure at a time: it swings by ``change`` (0.2: 20 %) from least to most.

    Two sines of unrelated periods, so that it neither repeats nor stops.
    """
    phase = 2.0 * math.pi * time_s / _EXPOSURE_PERIOD_S
    swing = 0.75 * math.sin(phase) + 0.25 * math.sin(2.618 * phase + 1.0)
    return 1.0 + 0.5 * change * swing


def sensor_image(light: F32, *, gain: float, noise: float, rng: np.random.Generator) -> U8:
    """Turn (H, W, C) light in grey values into what the sensor gives.

    noise: deviation in grey values, the same for all channels of a pixel, so that it is also the
    deviation of the grey image made from them.
    """
    exposed = light * np.float32(gain)
    if noise > 0.0:
        grain = rng.standard_normal(light.shape[:2], dtype=np.float32)
        exposed += np.float32(noise) * grain[:, :, None]
    return np.clip(np.rint(exposed), 0.0, 255.0).astype(np.uint8)
