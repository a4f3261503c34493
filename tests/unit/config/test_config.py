"""Configuration mistakes: one line that names file, key, what was found and what is allowed."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config import load, parse
from companion.config.sections import Config
from companion.errors import ConfigError

GOOD = """
[mavlink]
url = "udpout:127.0.0.1:14550"
[[imu]]
name = "fc"
source = "autopilot"
"""
MQTT = "[mqtt]\nhost = 'localhost'\n"
SERIAL = '[[imu]]\nname = "own"\nsource = "serial"\nport = "/dev/ttyUSB0"\nprotocol = "vectornav"\n'

BOTH = '[gradienter]\nport = "/dev/ttyUSB0"\nprotocol = "PROTOCOL"\nlaw = "euler"\n'
HMR_TWICE = (
    '[gradienter]\nport = "/dev/ttyS1"\nprotocol = "hmr3300"\nlaw = "euler"\nbaud = 19200\nparity = "none"\n'
    '[compass]\nport = "/dev/ttyS1"\nprotocol = "hmr3300"\nbaud = BAUD\n'
)


def test_the_smallest_file_and_its_defaults() -> None:
    config = parse(GOOD, "x.toml")
    assert isinstance(config, Config)
    assert config.mavlink.component_id == 191
    assert config.imu[0].instance is None
    assert config.calibration.min_still_s == 10
    assert config.calibration.max_s == 60
    assert config.calibration.at_arm == "warn"
    assert config.push.parameters
    assert config.mqtt is None


def test_the_autopilot_s_port_is_nobody_else_s() -> None:
    text = GOOD.replace("udpout:127.0.0.1:14550", "serial:/dev/ttyUSB0:115200") + SERIAL
    with pytest.raises(ConfigError, match=r"'mavlink.url': found '/dev/ttyUSB0', which imu\[1\].port has already"):
        parse(text, "x.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[vehcile]\nx = 1", ["vehcile", "did you mean 'vehicle'"]),
        ("[calibration]\nmin_stil_s = 3", ["calibration.min_stil_s", "did you mean 'min_still_s'"]),
        ("[vehicle]\nlatitude_deg = 'x'", ["vehicle.latitude_deg", "found 'x'", "a number from -90 to 90"]),
        ("[vehicle]\nlatitude_deg = 91\nlongitude_deg = 1", ["latitude_deg", "found 91", "-90 to 90"]),
        ("[vehicle]\nlatitude_deg = nan\nlongitude_deg = 1", ["latitude_deg", "found nan", "-90 to 90"]),
        ("[vehicle]\nlatitude_deg = 3", ["vehicle", "both or neither"]),
        ("[calibration]\nmin_still_s = true", ["min_still_s", "found true", "2 to 600"]),
        ("[calibration]\nmax_s = 5", ["calibration.max_s", "found 5", "min_still_s (10)"]),
        ("[storage]\nrecordings_mb = 3", ["storage.recordings_mb", "found 3", "0 (none) or at least 8"]),
        ("[calibration]\ntarget_gyro_sigma_deg_h = 0", ["target_gyro_sigma_deg_h", "found 0", "above 0"]),
        ("[calibration]\nat_arm = 'always'", ["at_arm", "found 'always'", '"gate", "warn", "off"']),
        (
            "[[imu]]\nname = 'b'\nsource = 'serial'\nprotocol = 'imu_line'",
            ["imu[1].port", "missing", "tcp://HOST:PORT"],
        ),
        (
            SERIAL.replace("vectornav", "vectonav"),
            ["imu[1].protocol", "'vectonav'", '"vectornav", "imu_line", "witmotion", "mip"'],
        ),
        (SERIAL.replace("own", "fc"), ["imu[1].name", "found 'fc'", "imu[0]", "a name of its own"]),
        (SERIAL + "mounting = 'ROTATION_YAW_91'", ["imu[1].mounting", "ROTATION_YAW_91", "did you mean"]),
        (SERIAL + "mounting = [1, 2, inf]", ["imu[1].mounting", "inf", "finite"]),
        (SERIAL + SERIAL.replace("own", "other"), ["imu[2].port", "/dev/ttyUSB0", "imu[1].port", "a port of its own"]),
        (
            SERIAL.replace("vectornav", "imu_line") + BOTH.replace("PROTOCOL", "hmr3300"),
            [
                "gradienter.protocol",
                "'hmr3300' on /dev/ttyUSB0",
                "imu[1].protocol is 'imu_line'",
                "one device serves both",
            ],
        ),
        (
            HMR_TWICE.replace("BAUD", "9600"),
            ["compass.baud", "found 9600 on /dev/ttyS1", "gradienter.baud is 19200", "or a port of its own"],
        ),
        (
            HMR_TWICE.replace("BAUD", "19200\nparity = 'odd'"),
            ["compass.parity", "'odd'", "gradienter.parity is 'none'"],
        ),
        (
            "[[imu]]\nname = 'b'\nsource = 'autopilot'\ninstance = 2\nread_only = true",
            ["imu[1].read_only", "only with"],
        ),
        (SERIAL + "read_only = 1", ["imu[1].read_only", "found 1", "true or false"]),
        (SERIAL + "autopilot_instance = 1", ["imu[1]", "autopilot IMU 1 a second time"]),
        ("[[imu]]\nname = 'b'\nsource = 'autopilot'\nport = '/dev/x'\ninstance = 2", ["imu[1].port", "only with"]),
        ("[[imu]]\nname = 'b'\nsource = 'autopilot'\ninstance = 4", ["imu[1].instance", "found 4", "from 1 to 3"]),
        ("[gradienter]\nport = '/dev/x'\nprotocol = 'inclinometer_xy'", ["gradienter.law", "missing", '"slope"']),
        (
            "[gradienter]\nport = 3\nprotocol = 'inclinometer_xy'\nlaw = 'axis'",
            ["gradienter.port", "found 3", "a text"],
        ),
        ("[compass]\nport = 'COM3'\nprotocol = 'hmr3300'", ["compass.port", "'COM3'", "tcp://HOST:PORT"]),
        (
            "[gradienter]\nport = '/dev/x'\nprotocol = 'inclinometer_xy'\nlaw = 'axis'\nmounting = 'ROTATION_ROLL_180'",
            ["gradienter.mounting", "ROTATION_ROLL_180", "upside down", "upright"],
        ),
        ("[mqtt]\nport = 1883", ["mqtt.host", "missing", "not empty"]),
        (MQTT + "prot = 1883", ["mqtt.prot", "did you mean 'port'"]),
        (MQTT + "port = 0", ["mqtt.port", "found 0", "1 to 65535"]),
        (MQTT + "keepalive_s = 1", ["mqtt.keepalive_s", "found 1", "5 to 600"]),
        (MQTT + "base_topic = 'field/#'", ["mqtt.base_topic", "found 'field/#'", "without + #"]),
        (MQTT + "client_id = 'a\\nb'".replace("'", '"'), ["mqtt.client_id", "printable"]),
        (MQTT + "password_file = '/etc/p'", ["mqtt.username", "missing", "needed by password_file"]),
        (MQTT + "username = 'u'\npassword_file = 'a/b'", ["mqtt.password_file", "begins with /", "credential"]),
        (MQTT + "ca_file = '/etc/ca.pem'", ["mqtt.ca_file", "only with tls = true"]),
        (MQTT + "tls = true\nca_file = 'ca.pem'", ["mqtt.ca_file", "found 'ca.pem'", "begins with /"]),
        (MQTT + "tls = true\nkey_file = '/etc/key.pem'", ["mqtt.cert_file", "missing", "needed by key_file"]),
        (
            "[[imu]]\nname = 'b'\nsource = 'autopilot'\ninstance = 2\nprofile = 'xyz'",
            ["imu[1].profile", "'xyz'", "bmi088"],
        ),
        (SERIAL + "instance = 2", ["imu[1].instance", "found 2", "only with source"]),
        (SERIAL + "mounting = [1e300, 0, 0]", ["imu[1].mounting", "360 degrees"]),
        (
            "[[imu]]\nname = 'b'\nsource = 'autopilot'\ninstance = 2\nmounting = 'ROTATION_YAW_90'",
            ["imu[1].mounting", "ROTATION_YAW_90", "only with source"],
        ),
        ("[compass]\nport = 'tcp://h:99999'\nprotocol = 'hmr3300'", ["compass.port", "tcp://h:99999", "allowed"]),
        ("[vehicle]\nlatitude_deg = 3 4", ["not valid TOML", "line 8"]),
    ],
)
def test_a_mistake_is_one_line_that_says_it_all(text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(GOOD + text, "the.toml")
    message = str(caught.value)
    assert "\n" not in message
    for word in ("the.toml", *words):
        assert word in message


@pytest.mark.parametrize("bind", ["192.168.4.1", "8191", ":8191", "::1:8191", "board.local:8191", "127.0.0.1:65536"])
def test_what_is_no_address_of_a_page_is_refused(bind: str) -> None:
    with pytest.raises(ConfigError, match=r"x\.toml: 'web\.bind': found .*allowed: ADDRESS:PORT, such as 127"):
        parse(GOOD + f'[web]\nbind = "{bind}"\n', "x.toml")


@pytest.mark.parametrize(
    "url", ["udpin:127.0.0.1:99999", "udpout:127.0.0.1:0", "serial:ttyUSB0:57600", "serial:/dev/x"]
)
def test_what_is_no_mavlink_url_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match=r"x\.toml: 'mavlink\.url': found .*allowed: udpin:HOST:PORT"):
        parse(GOOD.replace("udpout:127.0.0.1:14550", url), "x.toml")


def test_addresses_and_urls_are_taken_as_they_stand() -> None:
    for bind in ("127.0.0.1:8191", "localhost:8191", "0.0.0.0:80", "[::1]:8191"):
        web = parse(GOOD + f'[web]\nbind = "{bind}"\n', "x.toml").web
        assert web is not None
        assert web.bind == bind
    for url in ("serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0:57600", "tcp:autopilot.local:5760"):
        assert parse(GOOD.replace("udpout:127.0.0.1:14550", url), "x.toml").mavlink.url == url


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["mavlink", "missing"]),
        ("[mavlink]\nurl = 'x:1'\n[[imu]]\nname='a'\nsource='autopilot'", ["mavlink.url", "'x:1'", "udpin:HOST:PORT"]),
        ("[mavlink]\nurl = 'udpin:a:1'", ["imu", "missing", "[[imu]]"]),
        ("imu = []\n[mavlink]\nurl = 'udpin:a:1'", ["imu", "not empty"]),
        ("imu = 3\n[mavlink]\nurl = 'udpin:a:1'", ["imu", "found 3"]),
        ("[mavlink]\ncomponent_id = 3", ["mavlink.url", "missing"]),
    ],
)
def test_what_every_file_needs(text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text, "the.toml")
    for word in ("the.toml", *words):
        assert word in str(caught.value)


def test_a_missing_or_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: no such file"):
        load(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match=r"cannot be read: Is a directory$"):
        load(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path / "latin.toml")


def test_systemds_folders_are_the_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/here")
    monkeypatch.setenv("STATE_DIRECTORY", "/state/here")
    config = parse(GOOD, "x.toml")
    assert str(config.control.path) == "/run/here/control.sock"
    assert str(config.storage.path) == "/state/here"


def test_the_broker_by_default_and_with_tls(monkeypatch: pytest.MonkeyPatch) -> None:
    mqtt = parse(GOOD + MQTT, "x.toml").mqtt
    assert mqtt is not None
    assert (mqtt.broker_port, mqtt.base_topic, mqtt.password_path) == (1883, None, None)
    mqtt = parse(GOOD + MQTT + "tls = true\nusername = 'u'\npassword_file = 'mqtt.password'", "x.toml").mqtt
    assert mqtt is not None
    assert mqtt.broker_port == 8883
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", "/run/credentials/companion")
    assert mqtt.password_path == Path("/run/credentials/companion/mqtt.password")


COMPASS = "[compass]\nport = '/dev/ttyS1'\nprotocol = 'hmr3300'\n"
GRADIENTER = "[gradienter]\nport = '/dev/ttyS2'\nprotocol = 'inclinometer_xy'\nlaw = 'slope'\n"


def test_a_heading_out_of_the_field_needs_a_gradienter_and_magnetic_north() -> None:
    usual = parse(GOOD + COMPASS, "x.toml").compass
    assert usual is not None
    assert (usual.heading, usual.counts_per_gauss) == ("device", None)
    own = COMPASS + "heading = 'field'\ncounts_per_gauss = 4000\n"
    found = parse(GOOD + GRADIENTER + own, "x.toml").compass
    assert found is not None
    assert (found.heading, found.counts_per_gauss) == ("field", 4000)
    with pytest.raises(ConfigError, match=r"^x.toml: 'compass.heading': found 'field'; .*\[gradienter\]"):
        parse(GOOD + own, "x.toml")
    with pytest.raises(ConfigError, match=r"'compass.heading': found 'field'; .*magnetic"):
        parse(GOOD + GRADIENTER + own + "reference = 'true'\n", "x.toml")
    with pytest.raises(ConfigError, match=r"compass.counts_per_gauss"):
        parse(GOOD + COMPASS + "counts_per_gauss = 0\n", "x.toml")
