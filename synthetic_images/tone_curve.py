"""Tone curve of a scanner: from light to grey values, both as fractions of full scale."""

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

S_CURVE_STEEPNESS = 2.5  # of the hyperbolic tangent: slope of about 1.5 in the middle


def coded(light: Picture, tone: float | str) -> Picture:
    """Code light, 0 to 1, as grey values. tone: gamma (light to the power of 1 / tone), "srgb" (IEC 61966-2-1), or
    "s-curve", flat in shadows and highlights."""
    if tone == "srgb":
        low = 12.92 * light
        return np.asarray(np.where(light <= 0.0031308, low, 1.055 * light ** np.float32(1 / 2.4) - 0.055), np.float32)
    if tone == "s-curve":
        half = np.float32(S_CURVE_STEEPNESS / 2)
        return np.asarray(0.5 + np.tanh(S_CURVE_STEEPNESS * (light - 0.5)) / (2 * np.tanh(half)), np.float32)
    return np.asarray(light if tone == 1.0 else light ** np.float32(1 / float(tone)), np.float32)
