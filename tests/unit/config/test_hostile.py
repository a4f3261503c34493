"""Configurations that somebody made to hurt: one line, whatever is in them, and soon."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.cli import main
from companion.cli.terminal import USAGE
from companion.config import load, parse
from companion.errors import ConfigError

GOOD = '[mavlink]\nurl = "udpout:127.0.0.1:14550"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
MAVLINK = '[[imu]]\nname = "fc"\nsource = "autopilot"\n[mavlink]\nurl = "udpout:127.0.0.1:14550"\n'
PRINTABLE = "; allowed: printable characters"
NESTED = "not valid TOML: brackets within brackets, too deep"
TOO_LARGE = "found more than 65536 bytes; allowed: a configuration file"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 4000, NESTED),
        ("a = " + "{b = " * 700, NESTED),
        (f"[{'.'.join('a' * 1900)}]\n" * 2, "not valid TOML: Cannot declare ('a', 'a', "),
        (MAVLINK + f"url.{'.'.join('a' * 1900)} = 1", "not valid TOML: "),
        (MAVLINK + f"signing.{'.'.join('a' * 1900)} = 1", "'mavlink.signing': found {'a': {'a': {'a': {'a'"),
        (MAVLINK + "allow = " + "[" * 200 + "]" * 200, "'mavlink.allow[0]': found [[[[[[[...]]]]]]]; "),
        ("a = " + "9" * 5000, "line 1: found 5004 characters; allowed: 4096"),
        (".".join("a" * 3000) + " = 1", "line 1: found 6003 characters; allowed: 4096"),
        (
            MAVLINK + "component_id = " + "9" * 4000,
            "'mavlink.component_id': found a number of 13288 bits; allowed: a whole number from 2 to 255",
        ),
        (
            MAVLINK + "component_id = 0x" + "f" * 4000,
            "'mavlink.component_id': found a number of 16000 bits; allowed: a whole number from 2 to 255",
        ),
        (
            GOOD + "[calibration]\nmax_s = 0x" + "f" * 4000,
            "'calibration.max_s': found a number of 16000 bits; allowed: a number from 2 to 3600",
        ),
        ("#" * 70_000, TOO_LARGE),
        ("a = 1\n" * 20_000, TOO_LARGE),
        (GOOD + f"{'x' * 3000} = 1", "unknown key 'imu[0].xxx"),
        (GOOD + f'{"x" * 3000} = "', "not valid TOML: "),
        (GOOD.replace("autopilot", "x" * 3000), "'imu[0].source': found 'xxx"),
        (GOOD + '"\\u001b[31m" = 1', "unknown key 'imu[0].\\x1b[31m'; allowed: "),
        (GOOD.replace("fc", "f\\u001b[31mc"), f"'imu[0].name': found 'f\\x1b[31mc'{PRINTABLE}"),
        (GOOD.replace("fc", "f\\nc"), f"'imu[0].name': found 'f\\nc'{PRINTABLE}"),
        (GOOD.replace("fc", "f\u009bc"), f"'imu[0].name': found 'f\\x9bc'{PRINTABLE}"),
        (GOOD.replace("fc", "f\u202ec"), f"'imu[0].name': found 'f\\u202ec'{PRINTABLE}"),
        (GOOD.replace("fc", "f\u200bc"), f"'imu[0].name': found 'f\\u200bc'{PRINTABLE}"),
        (MAVLINK + 'allow = ["255", "2\\u001b"]', f"'mavlink.allow': found '2\\x1b'{PRINTABLE}"),
        (GOOD + '[storage]\ndirectory = "/a\\u0000b"', f"'storage.directory': found '/a\\x00b'{PRINTABLE}"),
        (GOOD + '[control]\nsocket = "/a\\u0000b"', f"'control.socket': found '/a\\x00b'{PRINTABLE}"),
        (GOOD + '[mqtt]\nhost = "h"\nbase_topic = "a\\u0007"', f"'mqtt.base_topic': found 'a\\x07'{PRINTABLE}"),
        (
            GOOD + '[gradienter]\nport = "/d"\nprotocol = "nmea"\nlaw = "axis"\noffset_deg = [0.0, [nan]]',
            "'gradienter.offset_deg': found nan; allowed: [number, number], finite",
        ),
        (MAVLINK + "component_id = 0", "'mavlink.component_id': found 0; allowed: a whole number from 2 to 255"),
        (MAVLINK + "component_id = 1", "'mavlink.component_id': found 1; allowed: a whole number from 2 to 255"),
    ],
)
def test_a_hostile_configuration_is_one_short_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    path = tmp_path / "the.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["history", "-c", str(path)]) == USAGE
    out, said = capsys.readouterr()
    assert out == ""
    assert said.startswith(f"{path}: {words}")
    assert said.count("\n") == 1
    assert said[:-1].isprintable()
    assert len(said) < len(str(path)) + 400


def test_no_more_is_read_of_a_file_than_may_be_in_it() -> None:
    with pytest.raises(ConfigError, match=f"/dev/zero: {TOO_LARGE}"):
        load(Path("/dev/zero"))


VALUES = st.recursive(
    st.one_of(
        st.integers().map(str), st.integers(64, 4000).map(lambda size: "0x" + "f" * size),
        st.sampled_from(["nan", "-inf", "1e999", "true", "1979-05-27", "07:32:00", '""', '"\\u202e"', "''", "'\x7f'"]),
        st.text(max_size=8).map(lambda words: '"' + "".join(f"\\U{ord(each):08x}" for each in words) + '"'),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4).map(lambda items: f"[{', '.join(items)}]"),
        inner.map(lambda item: f"{{ name = {item} }}"),
    ),
    max_leaves=6,
)  # fmt: skip
KEYS = st.sampled_from(
    ["mavlink.component_id", "mavlink.allow", "mavlink.signing_key_file", "vehicle.latitude_deg", "push.attitude",
     "calibration.max_s", "gradienter.offset_deg", "compass", "compass.mounting", "imu", "mqtt.host", "mqtt.port",
     "storage.recordings_mb", "web.bind", "log.level.deep.er", "control.group", "nobody.knows"]
)  # fmt: skip


@settings(max_examples=300)
@given(st.lists(st.tuples(KEYS, VALUES), min_size=1, max_size=4))
@example([("mavlink.signing", "[[0x" + "f" * 4000 + ", nan]]")])
def test_no_value_does_more_than_end_in_one_line(pairs: list[tuple[str, str]]) -> None:
    text = "".join(f"{key} = {value}\n" for key, value in pairs)
    try:
        parse(f'mavlink.url = "udpout:h:1"\n{text}', "the.toml")
    except ConfigError as error:
        words = str(error)
        assert words.isprintable()
        assert words.startswith("the.toml: ")
        assert len(words) < 700


@settings(max_examples=200)
@given(st.binary(max_size=300))
def test_no_bytes_do_either(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert str(caught.value).isprintable()
