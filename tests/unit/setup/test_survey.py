"""Result of listening, compared with an existing configuration."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from companion import cli, config
from companion.errors import ConfigError, LinkError
from companion.links.serial.listening import Heard
from companion.protocols.guess import Heartbeat, Line
from companion.setup import draft as drafting
from companion.setup.survey import HeardUdp, Survey, listen_udp

PX4, STATION = Heartbeat(1, 1, 2, 12), Heartbeat(255, 190, 6, 8)
SILENT = Heard(None, None, None, 0)


def test_autopilots_on_wires_come_first_and_stations_are_none() -> None:
    found = Survey(
        {"/dev/a": Heard(Line(921600, "none"), None, "MAVLink", 900, PX4), "/dev/b": SILENT, "/dev/c": "in use"},
        {
            14540: HeardUdp([PX4]),
            14550: HeardUdp([STATION], from_here=False),
            14551: HeardUdp([PX4, STATION], from_here=False),
        },
    )
    assert found.autopilots == ["serial:/dev/a:921600", "udpin:127.0.0.1:14540", "udpin:0.0.0.0:14551"]


def test_what_somebody_holds_is_not_silent(tmp_path: Path) -> None:
    held, quiet, alias, other = (tmp_path / name for name in ("held", "quiet", "alias", "other"))
    for path in (held, quiet, other):
        path.touch()
    alias.symlink_to(quiet)
    found = Survey({str(held): "in use by another program", str(quiet): SILENT}, {14540: "in use", 14550: _nobody()})
    assert [found.checked(str(path)) for path in (held, quiet, alias, other)] == [False, True, True, False]
    assert found.checked(str(tmp_path / "gone"))
    assert not found.checked("tcp://box:4000")
    urls = (
        "udpin:0.0.0.0:14540",
        "udpin:0.0.0.0:14550",
        "udpin:0.0.0.0:14551",
        "tcp:box:5760",
        f"serial:{alias}:57600",
    )
    assert [found.checked_url(url) for url in urls] == [False, True, False, False, True]


async def test_whoever_has_a_udp_port_is_named_with_how_it_is_ended() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        port, ours = held.getsockname()[1], os.getpid()
        reason = rf"^UDP {port}: in use by another program \(.+, process {ours}\): sudo kill {ours}, "
        with pytest.raises(LinkError, match=reason):
            await listen_udp(port)


def _nobody() -> HeardUdp:
    return HeardUdp()


def test_the_old_file_is_kept_and_a_link_is_followed(tmp_path: Path) -> None:
    real, link = tmp_path / "real" / "c.toml", tmp_path / "c.toml"
    link.symlink_to(real)
    assert drafting.put(link, drafting.sample()) is None
    assert drafting.put(link, "first") is None, "the sample is nobody's work"
    real.chmod(0o640)
    assert drafting.put(link, "second") == real.with_name("c.toml.old1")
    assert drafting.put(link, "third") == real.with_name("c.toml.old2")
    assert link.is_symlink()
    assert {path.name: path.read_text() for path in real.parent.iterdir()} == {
        "c.toml": "third",
        "c.toml.old1": "first",
        "c.toml.old2": "second",
    }
    assert {path.stat().st_mode & 0o777 for path in real.parent.iterdir()} == {0o640}
    assert drafting.holds(link, "third")
    assert not drafting.holds(tmp_path / "none", "third")


def test_where_nothing_can_be_written_that_is_said_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drafting.is_writable(tmp_path / "not" / "yet" / "there.toml")
    monkeypatch.setattr("os.access", lambda *_: False)
    missing = tmp_path / "c.toml"
    assert cli.main(["-c", str(missing), "setup", "--yes"]) == 1
    assert f"is not yours to write: sudo companion -c {missing} setup" in capsys.readouterr().err
    # The daemon's own start says the same with its own code: nobody is asked what cannot be kept.
    monkeypatch.setattr(config, "DEFAULT_PATH", missing)
    assert cli.main(["run"]) == 2
    assert (
        capsys.readouterr().err == f"{missing}: no such file: companion setup makes it (or give another with -c FILE)\n"
    )


def test_a_whole_answer_wins_over_a_longer_choice() -> None:
    numbers = [str(number) for number in range(1, 13)]
    assert (drafting.one_of("1", numbers), drafting.one_of(" 12 ", numbers)) == ("1", "12")
    for wrong in ("", " ", "13"):
        with pytest.raises(ConfigError, match="allowed: 1, 2, "):
            drafting.one_of(wrong, numbers)
