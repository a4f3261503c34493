"""What a recording begins with: the state of collector and decoders, exactly; nothing that a file could smuggle in."""

from __future__ import annotations

import datetime
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.solution.site import Whereabouts
from companion.errors import StorageError
from companion.protocols.registry import PROTOCOLS, Kind
from companion.recording.state import freeze, from_json, to_json
from sim.aircraft import VirtualAircraft
from sim.binary_imus import MipImu, Stim300, XsensImu
from sim.compasses import NmeaCompass, Os5000
from sim.devices import HMR3300, Gradienter, SerialDevice, VectorNavBinary
from sim.gradienters import Jewell
from sim.imu_model import ImuModel
from sim.pni import PniCompass
from sim.rion import RionCompass
from sim.scenario import site_at
from sim.witmotion import WitMotionImu
from tests.support.decoders import make_decoder
from tests.support.frames import imu_line
from tests.support.rig import POSE
from tests.support.still_aircraft import Feeder, imu, settings


def stream(protocol: str) -> bytes:
    """Some seconds of a device, with noise and a false start in between."""
    aircraft = VirtualAircraft(POSE, site_at(40.0, 116.0, 50.0))
    if protocol == "imu_line":
        good = b"".join(imu_line(k, 5000 * k) for k in range(400))
    else:
        makers: dict[str, Callable[[], SerialDevice]] = {
            "vectornav": lambda: VectorNavBinary(ImuModel(aircraft, "adis16470", seed=1)),
            "mip": lambda: MipImu(ImuModel(aircraft, "adis16470", seed=1)),
            "xsens": lambda: XsensImu(ImuModel(aircraft, "adis16470", seed=1)),
            "stim300": lambda: Stim300(ImuModel(aircraft, "adis16470", seed=1), range_g=5),
            "inclinometer_xy": lambda: Gradienter(aircraft, seed=1, law="slope"),
            "hmr3300": lambda: HMR3300(aircraft, seed=1),
            "pni": lambda: PniCompass(aircraft, seed=1, continuous=True),
            "rion": lambda: RionCompass(aircraft, seed=1, automatic=True),
            "witmotion": lambda: WitMotionImu(ImuModel(aircraft, "adis16470", seed=1)),
            "jewell": lambda: Jewell(aircraft, seed=1, output="XDR"),
            "nmea": lambda: NmeaCompass(aircraft, seed=1, sentences=("HDT", "HDG", "XDR", "HPR")),
            "os5000": lambda: Os5000(aircraft, seed=1, vectors=True),
        }
        device = makers[protocol]()
        device.power_on(0.0)
        good = b"".join(frame.data for frame in device.frames_until(6.0))
    return good[:500] + b"\xfa\x01$IMU,X=1" + good[500:]


@pytest.mark.parametrize(("kind", "protocol"), [(kind, name) for kind, of in PROTOCOLS.items() for name in of])
def test_a_decoder_goes_on_from_its_state_as_if_nothing_had_been(kind: Kind, protocol: str) -> None:
    data = stream(protocol)
    rng = np.random.default_rng(5)
    for cut in rng.integers(1, len(data), size=25).tolist():
        decoder = make_decoder(kind, protocol, 1e-5)
        decoder.receive(data[:cut], 1.0)
        again = from_json(to_json(freeze(decoder)))
        assert type(again) is type(decoder)
        rest = data[cut:]
        assert again.receive(rest, 2.0) == decoder.receive(rest, 2.0)
        assert again.times.status() == decoder.times.status()
        assert (again.accepted, again.rejected, again.skipped) == (decoder.accepted, decoder.rejected, decoder.skipped)


def collector() -> RollingCollector:
    return RollingCollector(settings(), [imu("fc"), imu("two")], gradienter=True, compass=True)


def feeder(to: RollingCollector, seed: int) -> Feeder:
    made = Feeder(to, ("fc", "two"), seed=seed)
    made.tilt, made.heading = lambda t_s: (0.1, -0.2), lambda t_s: 359.9
    return made


@pytest.mark.parametrize("seconds", [0.0, 0.3, 7.4, 33.2, 90.0])
def test_a_collector_goes_on_from_its_state_to_the_last_bit(seconds: float) -> None:
    one = collector()
    first = feeder(one, 1)
    first.run(seconds)
    one.status(first.now_s)
    frozen = freeze(one)
    other = from_json(to_json(frozen))
    assert isinstance(other, RollingCollector)
    for each in (one, other):
        rest = feeder(each, 2)
        rest.now_s = first.now_s
        rest.run(20.0)
        each.glance(rest.now_s)
    assert one.window(rest.now_s) == other.window(rest.now_s)
    # What happened after freezing has not reached what was frozen.
    assert to_json(frozen) == to_json(freeze(from_json(to_json(frozen))))


@pytest.mark.parametrize(
    "value",
    [
        None,
        [1, 2.5, "text", True],
        (1, (2, 3)),
        {"a": 1, 3: (4,)},
        deque([1, 2], maxlen=5),
        math.inf,
        b"\x00\xff",
        Whereabouts(1.0, None, 3.0, "here", datetime.date(2026, 5, 1)),
    ],
)
def test_plain_values_come_back_as_they_were(value: Any) -> None:
    again = from_json(to_json(freeze(value)))
    assert again == value
    assert type(again) is type(value)
    if isinstance(value, deque):
        assert again.maxlen == value.maxlen


@pytest.mark.parametrize(
    "text",
    [
        '{"$": "Path", "is": {}}',
        '{"$": "eval", "of": ["1"]}',
        '{"$": "array", "type": "O", "shape": [1], "data": "AAAAAAAAAAA="}',
        '{"$": "array", "type": "<f8", "shape": [9], "data": "AAAAAAAAAAA="}',
        '{"$": "Whereabouts", "is": {"nothing": 1}}',
        '{"no": "tag"}',
        "[" * 60 + "]" * 60,
        '{"$": "dict", "of": [[1]]}',
        "nonsense",
    ],
)
def test_what_no_recording_of_ours_holds_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(StorageError, match="of another version or damaged"):
        from_json(text)


def test_what_is_not_known_is_not_written() -> None:
    with pytest.raises(TypeError, match="Unknown is not known"):
        to_json(freeze({"a": type("Unknown", (), {})()}))
