"""Default sigmas of devices, and suspicious configurations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import parse
from companion.config.sections import Config
from companion.configured import models

AUTOPILOT = '[mavlink]\nurl = "tcp:h:1"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'


def config(protocol: str, law: str = "euler", *, gradienter: str = "", compass: str = "") -> Config:
    return parse(
        f'{AUTOPILOT}[gradienter]\nport = "/dev/a"\nprotocol = "{protocol}"\nlaw = "{law}"\n{gradienter}\n'
        f'[compass]\nport = "/dev/b"\nprotocol = "hmr3300"\n{compass}\n',
        "test",
    )


def up(tilt_deg: float) -> np.ndarray:
    """Up in axes that are tilted by so much about the forward one."""
    tilt = math.radians(tilt_deg)
    return np.array([0.0, -math.sin(tilt), -math.cos(tilt)])


@pytest.mark.parametrize(
    ("protocol", "said", "sigma_deg"),
    [
        ("inclinometer_xy", "", 0.05),
        # Null 0.4, accuracy 0.5 degrees to 30 degrees of tilt (Honeywell).
        ("hmr3300", "", math.hypot(0.4, 0.5)),
        ("hmr3300", "sigma_deg = 0.1", 0.1),
    ],
)
def test_a_gradienter_is_known_as_well_as_its_device_allows(protocol: str, said: str, sigma_deg: float) -> None:
    model = models.gradienter_model(config(protocol, gradienter=said).gradienter)
    assert model is not None
    assert model.sigma_deg == pytest.approx(sigma_deg)


@pytest.mark.parametrize(
    ("said", "mounting", "tilt_deg", "sigma_deg"),
    [
        ("", "", 0.5, 1.0),
        ("", "", 10.0, 3.0),
        ("", "mounting = [20, 0, 0]", 0.0, 3.0),  # it is the compass that has to be level
        ("", "mounting = [20, 0, 0]", -20.0, 1.0),
        ("sigma_deg = 2", "", 0.0, 2.0),
        ("sigma_deg = 2", "", 10.0, 2.0),
    ],
)
def test_a_compass_is_known_better_while_it_is_level(
    said: str, mounting: str, tilt_deg: float, sigma_deg: float
) -> None:
    model = models.compass_model(config("hmr3300", compass=f"{said}\n{mounting}").compass)
    assert model is not None
    assert model.sigma_at(up(tilt_deg)) == sigma_deg


def test_a_doubtful_law_is_named_with_the_right_one() -> None:
    assert models.doubtful_settings(config("hmr3300")) == []
    # Nobody but the user can know the law of those.
    assert models.doubtful_settings(config("inclinometer_xy", "slope")) == []
    (words,) = models.doubtful_settings(config("hmr3300", "axis"))
    assert 'found "axis"' in words
    assert '"euler"' in words
    assert models.doubtful_settings(parse(AUTOPILOT, "test")) == []
