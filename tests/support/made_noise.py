"""Noise of known N, B and K, made without the companion's or the simulator's models: an independent judge."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEG_H: Final = math.pi / 180.0 / 3600.0
DEG: Final = math.pi / 180.0
MG: Final = 9.80665e-3
FLICKER_OF_FLOOR: Final = 1.0 / math.sqrt(2.0 * math.log(2.0) / math.pi)


_FINER: Final = 8
"""Steps a second in which the slow parts are made, before they are averaged over whole seconds as a sensor's are."""


def slow(rng: np.random.Generator, seconds: int, flicker: float, walk: float, white: float = 0.0) -> Floats:
    """(seconds,) means of whole seconds: 1/f by shaping a spectrum twice as long, random walk by summing, white."""
    many = seconds * _FINER
    size = 1 << math.ceil(math.log2(2 * many))
    frequency = np.fft.rfftfreq(size, 1.0 / _FINER)
    density = np.zeros_like(frequency)
    density[1:] = flicker**2 / (2.0 * math.pi * frequency[1:])  # two-sided; E|X|^2 = size * rate * density
    spectrum = np.sqrt(size * _FINER * density / 2.0)
    spectrum = spectrum * (rng.normal(size=len(frequency)) + 1j * rng.normal(size=len(frequency)))
    path = np.fft.irfft(spectrum, size)[:many] + np.cumsum(rng.normal(0.0, walk / math.sqrt(_FINER), many))
    return np.asarray(path.reshape(seconds, _FINER).mean(axis=1) + rng.normal(0.0, white, seconds))


def adis16405(seconds: int, rate_hz: int, seed: int) -> tuple[Floats, Floats]:
    """Times and readings (n, 6) of a part with the figures measured of the ADIS16405 (method 2.2).

    Gyros: N 141 to 152 deg/h sqrt(s), floor 25 to 29 deg/h, steps of 0.05 deg/s, a walk that reaches the floor at
    1000 s. Accelerometers: N 669 ug sqrt(s), floor 269 ug, K 58 ug / sqrt(s).
    """
    rng = np.random.default_rng(seed)
    whites = [141.0 * DEG_H, 146.0 * DEG_H, 152.0 * DEG_H, *[0.669 * MG] * 3]
    floors = [25.0 * DEG_H, 27.0 * DEG_H, 29.0 * DEG_H, *[0.269 * MG] * 3]
    readings = np.empty((seconds * rate_hz, 6))
    walks = [*(floor * math.sqrt(3.0 / 1000.0) for floor in floors[:3]), *[0.058 * MG] * 3]
    for column, (white, floor, walk) in enumerate(zip(whites, floors, walks, strict=True)):
        path = slow(rng, seconds, floor * FLICKER_OF_FLOOR, walk)
        noise = rng.normal(0.0, white * math.sqrt(rate_hz), seconds * rate_hz)
        readings[:, column] = np.repeat(path, rate_hz) + noise
    readings += [0.3 * DEG, -0.2 * DEG, 0.1 * DEG, 0.2, -0.1, -9.8]
    readings[:, :3] = np.rint(readings[:, :3] / (0.05 * DEG)) * (0.05 * DEG)
    return np.arange(seconds * rate_hz) / rate_hz, readings


def write_csv(path: Path, t_s: Floats, readings: Floats) -> Path:
    head = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2"
    rows = np.column_stack([t_s, readings])
    np.savetxt(path, rows, fmt=["%.6f", *["%.9g"] * 6], delimiter=",", header=head, comments="")
    return path


def filtered(
    seconds: int, rate_hz: int, white: tuple[float, float], corner_hz: float, poles: int, seed: int, every: int = 1
) -> tuple[Floats, Floats]:
    """Times and readings (n, 6) of a still IMU behind a low-pass filter, made in the frequency domain.

    Args:
        white: N of gyros and accelerometers, rad/s and m/s^2 times sqrt(s).
        corner_hz: of a Butterworth filter.
        every: the filter's own rate over that of the stream, which takes every such sample.
    """
    rng = np.random.default_rng(seed)
    inner_hz = rate_hz * every
    many = seconds * inner_hz
    size = 1 << math.ceil(math.log2(many + inner_hz))
    gain = 1.0 / np.sqrt(1.0 + (np.fft.rfftfreq(size, 1.0 / inner_hz) / corner_hz) ** (2 * poles))
    readings = np.empty((seconds * rate_hz, 6))
    for column in range(6):
        noise = rng.normal(0.0, white[column // 3] * math.sqrt(inner_hz), size)
        readings[:, column] = np.fft.irfft(np.fft.rfft(noise) * gain, size)[:many:every]
    readings += [0.3 * DEG, -0.2 * DEG, 0.1 * DEG, 0.2, -0.1, -9.8]
    return np.arange(len(readings)) / rate_hz + 0.0003, readings
