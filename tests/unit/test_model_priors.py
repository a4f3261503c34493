"""What a fleet tells of an IMU's model: what is refused, kept, judged; and what a good and a bad one do."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion import config
from companion.autopilot.firmware.firmwares import model_of
from companion.calibration.records.history import Point
from companion.calibration.solution.model_prior import MOST_BYTES, TriadPrior, read
from companion.calibration.solution.prior import expect
from companion.calibration.temperature.curve import Node, PowerUpNodes, fit
from companion.daemon.biases.model_priors import ModelPriors
from companion.errors import ConfigError
from companion.physics.frames import vector
from tests.prior_study import STEADY, Case, study
from tests.support.extent import extent
from tests.support.fleet import Aircraft, check
from tests.support.virtual_time import run_virtual
from tests.unit.test_calibration_prior import ASSUMED, DEG_H, MG, now, point, some

MODEL = "icm42688p"
TOPIC = f"fleet/priors/{MODEL}"
GOOD: dict[str, Any] = {
    "format_version": 1,
    "model": MODEL,
    "parts": 31,
    "turn_ons": 812,
    "gyro_rad_s": {
        "scatter": [30 * DEG_H] * 3,
        "scatter_sigma": [5 * DEG_H] * 3,
        "per_k": [10 * DEG_H, 0, -10 * DEG_H],
        "per_k_spread": [6 * DEG_H] * 3,
    },
    "accel_m_s2": {"scatter": [0.3 * MG] * 3, "scatter_sigma": [0.05 * MG] * 3, "per_k": None, "per_k_spread": None},
}


def payload(**other: object) -> bytes:
    return json.dumps(GOOD | other).encode()


def gyro(**other: object) -> bytes:
    return payload(gyro_rad_s=GOOD["gyro_rad_s"] | other)


def accel(**other: object) -> bytes:
    return payload(accel_m_s2=GOOD["accel_m_s2"] | other)


def test_what_is_told_is_by_the_contract_and_is_read() -> None:
    check("prior", payload())
    gyros, accels = read(payload(), MODEL).of("gyro"), read(payload(), MODEL).of("accel")
    assert gyros is not None
    assert gyros.scatter == pytest.approx([30 * DEG_H] * 3)
    assert accels is not None
    assert accels.per_k is None
    assert read(payload(gyro_rad_s=None), MODEL).of("gyro") is None


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (payload(format_version=2), "found format 2; allowed: up to 1"),
        (payload(model="bmi088"), "found model 'bmi088'; allowed: 'icm42688p'"),
        (payload(parts=2), "parts"),
        (gyro(scatter=[1e-9, 1e-4, 1e-4]), "gyro scatter: found 1e-09"),
        (gyro(scatter=[-1e-4] * 3), "gyro scatter: found -0.0001"),
        (gyro(scatter=[1e300] * 3), "gyro scatter: found 1e\\+300"),
        (gyro(scatter_sigma=[0.0] * 3), "gyro scatter_sigma: found 0"),
        (gyro(per_k=[0.1] * 3), "gyro per_k: found 0.1"),
        (accel(scatter=[9.8] * 3), "accel scatter: found 9.8"),
        (accel(scatter=["a"] * 3), "float"),
        (accel(scatter=[0.1]), "length 3"),
        (payload().replace(b"812", b"NaN"), "malformed"),
        (b"[" * 4000, "expected `object`"),
        (b"\xff\xfe", "malformed"),
        (b"{}" + b" " * 10_000_000, f"found 10000002 bytes; allowed: up to {MOST_BYTES}"),
    ],
)
def test_what_no_part_shows_is_refused_in_one_line(told: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=f"(?i){words}") as refused:
        read(told, MODEL)
    assert "\n" not in str(refused.value)


def test_any_bytes_are_read_or_refused() -> None:
    dice = np.random.default_rng(1)
    for _ in range(3000):
        told = bytearray(payload())
        for at in dice.integers(0, len(told), dice.integers(1, 6)):
            told[at] = dice.integers(0, 256)
        try:
            found = read(bytes(told), MODEL)
        except ValueError:
            continue
        assert (known := found.of("gyro")) is None or min(known.scatter) > 0.0


def test_a_model_is_known_by_firmware_and_types() -> None:
    ids = (0x34 << 16 | 0x1234, 0x34 << 16 | 0x4321)
    assert model_of("ardupilot", *ids) == "icm42688p"
    assert model_of("px4", 0x26 << 16 | 1, 0x26 << 16 | 2) == "icm42688p"
    assert model_of("px4", *ids) == "px4-0x34-0x34"
    assert model_of(None, *ids) is None
    assert model_of("ardupilot", None, 1) is None
    assert model_of("px4", 0, 1) is None


# --- kept on the aircraft


def kept(folder: Path) -> ModelPriors:
    found = ModelPriors(folder, lambda: {"fc": MODEL})
    found.load()
    return found


def test_it_is_kept_without_a_network_and_what_is_refused_changes_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    models = kept(tmp_path)
    assert models.of("fc", "gyro") is None
    assert "told nothing of its model (icm42688p) yet" in models.status()[0]["summary"]
    models.take("fleet/priors/bmi088", payload(model="bmi088"))
    assert not any(tmp_path.iterdir())
    models.take(TOPIC, payload())
    known = models.of("fc", "gyro")
    assert known is not None
    assert kept(tmp_path).of("fc", "gyro") == known
    assert models.of("own", "gyro") is None
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            models.take(TOPIC, payload(parts=1))
    assert len(caplog.records) == 1
    assert kept(tmp_path).of("fc", "gyro") == models.of("fc", "gyro") == known
    assert f"{TOPIC}: not taken: " in models.status()[0]["summary"]
    models.take(TOPIC, b"")
    assert kept(tmp_path).of("fc", "gyro") is None


def test_a_spoilt_file_is_set_aside(tmp_path: Path) -> None:
    kept(tmp_path).take(TOPIC, payload())
    spoilt = GOOD | {"gyro_rad_s": {"scatter": [9, 9, 9], "scatter_sigma": [1, 1, 1]}}
    (tmp_path / "model-priors.json").write_bytes(payload(models={MODEL: spoilt}))
    assert kept(tmp_path).of("fc", "gyro") is None
    assert (tmp_path / "model-priors.json.unusable").exists()


def test_a_broker_tells_it_retained_and_the_next_start_needs_none(tmp_path: Path) -> None:
    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        async with aircraft.running(kept(tmp_path)) as face:
            aircraft.connection.connect()
            await asyncio.sleep(15.0)
            assert TOPIC in aircraft.connection.heard
            aircraft.connection.deliver(TOPIC, payload(), retained=True)
            await asyncio.sleep(15.0)
            assert "fc: model icm42688p of the fleet (31 parts): gyro not judged yet" in face.status()["summary"]
            assert face.status()["good"]
            aircraft.connection.deliver(TOPIC, payload(format_version=9), retained=True)
            await asyncio.sleep(15.0)
            assert "not taken: found format 9" in face.status()["summary"]
        assert kept(tmp_path).of("fc", "gyro") is not None

    run_virtual(main())


def test_it_needs_a_fleet() -> None:
    text = '[mavlink]\nurl = "udpin:127.0.0.1:14550"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
    wanted = text + "[calibration]\nfleet_prior = true\n"
    with pytest.raises(ConfigError, match=r"'fleet' is missing.*calibration\.fleet_prior"):
        config.parse(wanted, "c.toml")
    assert config.parse(f'{wanted}[mqtt]\nhost = "b"\n[fleet]\n', "c.toml").calibration.fleet_prior
    assert not config.parse(text, "c.toml").calibration.fleet_prior


# --- judged by the aircraft's own power-ups


def usual(scatter_deg_h: float, per_k: tuple[float, float] | None = None) -> TriadPrior:
    of_axes = (scatter_deg_h, 0.2 * scatter_deg_h, *(per_k or (None, None)))
    return TriadPrior(*(None if each is None else (each * DEG_H,) * 3 for each in of_axes))  # type: ignore[arg-type]


def of(points: Sequence[Point], known: TriadPrior | None, degc: float = 25.0) -> Any:
    return expect(points, "gyro", now(degc), ASSUMED, STEADY, known)


def test_two_power_ups_guard_and_three_weigh_where_the_model_is_known() -> None:
    points = [point(bias, str(k)) for k, bias in enumerate(some(4, scale=30.0 * DEG_H))]
    assert of(points[:1], usual(15.0)) is None
    assert of(points[:2], None) is None
    two, three, without = of(points[:2], usual(15.0)), of(points[:3], usual(15.0)), of(points[:3], None)
    assert (two.power_ups, two.weighs, two.by_model) == (2, False, True)
    assert (three.weighs, without.weighs, without.by_model) == (True, False, False)
    assert three.limit < without.limit


def test_own_power_ups_that_contradict_it_are_taken_alone() -> None:
    points = [point(bias, str(k)) for k, bias in enumerate(some(4, scale=30.0 * DEG_H))]
    for lie, sign in ((3.0, 1.0), (1000.0, -1.0)):
        found = of(points, usual(lie))
        assert not found.by_model
        assert sign * found.of_model > 2.0
        alone = of(points, None)
        assert (found.value, found.variance, found.limit, found.weighs) == (
            alone.value,
            alone.variance,
            alone.limit,
            alone.weighs,
        )
        assert of(points[:2], usual(lie)) is None


def test_parts_as_their_model_says_contradict_it_by_chance_only() -> None:
    for count in (2, 3, 5):
        draws = [some(count, seed=seed, scale=30.0 * DEG_H) for seed in range(60)]
        known = TriadPrior((30.0 * DEG_H,) * 3, (0.2 * DEG_H,) * 3)
        nodes = [[PowerUpNodes([Node(25.0, vector(bias), 1e-14)]) for bias in draw] for draw in draws]
        surprises = [curve.surprise for each in nodes if (curve := fit(each, 1e-14, 50.0 * DEG_H, usual=known.usual))]
        assert len(surprises) == 60
        assert abs(np.mean(surprises)) < 0.35
        assert 0.7 < np.std(surprises) < 1.3


def test_a_slope_that_own_power_ups_have_not_seen_is_no_promise() -> None:
    biases = some(3, scale=30.0 * DEG_H)
    same = [point(bias, str(k), temperature=20.0) for k, bias in enumerate(biases)]
    lie = of(same[:2], usual(30.0, (100.0, 0.1)), degc=40.0)
    assert not lie.weighs
    # Whatever part it is, it is no contradiction that it does not move.
    assert (np.abs(np.subtract(lie.value, biases[:2].mean(axis=0))) < lie.limit * np.sqrt(lie.variance)).all()
    apart = [point(bias, str(k), temperature=10.0 + 12.0 * k) for k, bias in enumerate(biases)]
    assert not of(apart, usual(30.0, (100.0, 0.1)), 20.0).by_model
    moves = np.array([10.0, 10.0, 10.0]) * DEG_H
    true = [point(b + moves * (10.0 + 12.0 * k), str(k), temperature=10.0 + 12.0 * k) for k, b in enumerate(biases)]
    having, without = of(true, usual(15.0, (10.0, 3.0)), 20.0), of(true, None, 20.0)
    assert having.by_model
    np.testing.assert_allclose(having.value, biases.mean(axis=0) + 20.0 * moves, atol=60.0 * DEG_H)
    assert (np.sqrt(having.variance) < 0.8 * np.sqrt(without.variance)).all()


# --- simulated: good ones help, bad ones cost next to nothing

NOISY: dict[str, Any] = {"stat": 47.0, "use": 63.0, "scatter": 30.0, "parts_differ": 0.15}
QUIET: dict[str, Any] = NOISY | {"stat": 1.6, "use": 5.0}


def of_study(name: str, power_ups: int, **case: Any) -> Any:
    return study(Case(name=name, power_ups=power_ups, **case), extent(whole=2000, a_slice=150), seed=7)


def test_a_good_one_betters_the_first_calibrations() -> None:
    alone, told = (of_study("noisy", 3, **NOISY, **known) for known in ({}, {"usual": 30.0}))
    assert told.ratio < 0.85 < alone.ratio == 1.0
    assert told.coverage > 0.9
    alone, told = (of_study("quiet", 3, **QUIET, **known) for known in ({}, {"usual": 30.0}))
    assert told.foretold_sigma < 0.85 * alone.foretold_sigma
    assert told.foretold_coverage > 0.93
    # Another sensor than before is found earlier.
    alone, told = (of_study("other", 2, **QUIET, jump=300.0, **known) for known in ({}, {"usual": 30.0}))
    assert alone.doubted == 0.0
    assert told.doubted > 0.6


@pytest.mark.parametrize("lie", [{"usual": 3.0}, {"usual": 10.0, "usual_sigma": 0.01}, {"usual": 90.0}])
def test_a_lie_costs_little(lie: dict[str, float]) -> None:
    for law in (NOISY, QUIET):
        alone, told = (of_study("lie", 3, **law, **known) for known in ({}, lie))
        assert told.rms_with <= 1.02 * alone.rms_with
        assert told.doubted <= alone.doubted + 0.04
