"""Bad thermometers are named and not believed; thermometers that are merely calm, coarse or heated are."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from companion.autopilot.firmware import imu_messages
from companion.estimation.collector.intake import Thermometer

Degc = Callable[[int], float | None]


def warm(t_s: int) -> float:
    """A board of 31 degC that comes from 11, with its noise."""
    return round(31.0 - 20.0 * math.exp(-t_s / 300.0) + 0.02 * math.sin(37.0 * t_s), 2)


def shown(seconds: int, **by: Degc) -> tuple[dict[str, Thermometer], dict[str, list[float | None]]]:
    thermometers = {name: Thermometer() for name in by}
    found = {
        name: [thermometers[name].believed(slot, degc(slot)) for slot in range(seconds)] for name, degc in by.items()
    }
    return thermometers, found


@pytest.mark.parametrize(
    ("degc", "words"),
    [
        (lambda t_s: warm(t_s) + 273.15, r"shows 3\d\d\.\d\d, allowed -40 to 105 degC: in another unit\?"),
        (lambda t_s: -300.0, r"shows -300.00, allowed -40 to 105 degC"),
        (lambda t_s: warm(t_s) + (40.0 if t_s % 100 == 99 else 0.0), "jumps: more than 5 K within a second"),
    ],
)
def test_a_bad_one_is_named_with_what_was_found_and_not_believed(degc: Degc, words: str) -> None:
    thermometers, found = shown(1000, fc=degc, own=warm)
    line = thermometers["fc"].wrong
    assert line.startswith("its thermometer ")
    assert line.endswith("; its temperature is not used")
    assert "\n" not in line
    assert len(line) < 120
    assert re.search(words, line), line
    assert found["fc"][-1] is None
    assert found["own"][5:] == [warm(t_s) for t_s in range(5, 1000)]
    assert thermometers["own"].wrong == ""


def test_jumps_are_forgiven_after_ten_minutes() -> None:
    thermometers, found = shown(800, fc=lambda t_s: warm(t_s) + (40.0 if t_s == 100 else 0.0))
    assert found["fc"][100:102] == [None, None]
    assert found["fc"][600] is None
    assert found["fc"][799] == warm(799)
    assert thermometers["fc"].wrong == ""


def test_without_a_temperature_an_imu_is_named_after_seconds() -> None:
    thermometers, _ = shown(10, fc=lambda t_s: None)
    found = [
        (thermometers["fc"].believed(*shown), thermometers["fc"].none) for shown in ((9, None), (11, None), (12, 20.0))
    ]
    assert found == [(None, False), (None, True), (20.0, False)]
    assert thermometers["fc"].wrong == ""


def test_nothing_from_the_wire_makes_it_raise() -> None:
    random = np.random.default_rng(0)
    thermometers = {name: Thermometer() for name in ("fc", "own", "third")}
    odd = [None, math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0, -0.0, 5e-324, 31.0]
    for _ in range(3000):
        slot, name = int(random.integers(-5, 5000)), str(random.choice(["fc", "own", "third"]))
        found = thermometers[name].believed(slot, odd[random.integers(len(odd))])
        assert found is None or -40.0 <= found <= 105.0


def test_of_the_autopilots_messages_only_those_that_carry_the_imus_temperature_give_one() -> None:
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    nine = (0.0, 0.0, -9.8, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0)
    floats = mavlink.MAVLink_highres_imu_message(5, *nine, 1013.0, 0.0, 50.0, 32.6, 0x3F)
    found = imu_messages.HIGHRES.decode(floats, 0.0)
    assert not isinstance(found, str)
    assert found.temperature_degc is None  # the air's, or the barometer's
    for sent, degc in ((2513, 25.13), (0, None), (1, 0.01), (-1250, -12.5)):
        whole = mavlink.MAVLink_scaled_imu_message(5, 0, 0, -1000, 1, 0, 0, 0, 0, 0, sent)
        found = imu_messages.SCALED.decode(whole, 0.0)
        assert not isinstance(found, str)
        assert found.temperature_degc == (None if degc is None else pytest.approx(degc))
