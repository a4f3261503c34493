"""Common parameters of the parts of a model, against those of the draws."""

from __future__ import annotations

import numpy as np
import pytest

from companion.autopilot.firmware.firmwares import model_of
from companion.fleet.sequential import LEAST_PARTS, scatter_of_model, scatter_of_part
from companion.physics.frames import Floats

TRUE = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 5.0])


def drawn(n: int, seed: int, wander: float = 0.0, scale: float = 1.0) -> tuple[Floats, Floats]:
    """Biases over power-ups with a slope over temperature, and the temperatures."""
    dice = np.random.default_rng(seed)
    degc = dice.uniform(0.0, 40.0, n)
    walk = np.cumsum(dice.normal(0.0, wander, (n, 6)), axis=0)
    return TRUE * (walk + scale * dice.normal(0.0, 1.0, (n, 6)) + 0.3 * degc[:, None] + 50.0), degc


def test_scatter_is_that_of_the_draws_whatever_the_temperature_and_a_step() -> None:
    biases, degc = drawn(600, 1)
    biases[300:] += 40.0 * TRUE
    biases[::50] += 100.0
    found = scatter_of_part(biases, degc)
    assert found[0] == pytest.approx(TRUE, rel=0.12)


def test_too_few_tell_nothing() -> None:
    assert np.isnan(scatter_of_part(*drawn(7, 1))[0]).all()
    few = [scatter_of_part(*drawn(60, seed)) for seed in range(LEAST_PARTS - 1)]
    assert scatter_of_model(few) is None
    empty = np.full((2, 6), np.nan)
    assert scatter_of_model([*few, empty]) is None


def test_a_model_is_known_by_firmware_and_types() -> None:
    ids = (0x34 << 16 | 0x1234, 0x34 << 16 | 0x4321)
    assert model_of("ardupilot", *ids) == "icm42688p"
    assert model_of("px4", 0x26 << 16 | 1, 0x26 << 16 | 2) == "icm42688p"
    assert model_of("px4", *ids) == "px4-0x34-0x34"
    assert model_of(None, *ids) is None
    assert model_of("ardupilot", None, 1) is None
    assert model_of("px4", 0, 1) is None
