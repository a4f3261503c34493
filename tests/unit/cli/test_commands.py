"""The command line without a daemon: its help, old and misspelt names, the stored history, what a result claims."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion import cli
from companion.cli import show
from companion.storage.records import RecordStore, armings_in
from tests.support.histories import record

Captured = pytest.CaptureFixture[str]


def said(words: list[str], capsys: Captured) -> str:
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert end.value.code == 2
    return capsys.readouterr().err


def test_help_is_one_screen_with_every_command(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    assert end.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 26
    assert max(map(len, lines)) <= 90
    listed = {line.split()[0] for line in lines if line.startswith("  ")}
    assert listed == {name for names in cli.GROUPS.values() for name in names}
    assert listed | {"help"} == set(cli._parser().commands._to.choices)


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["monitor"], "no command 'monitor'; type companion status --watch"),
        (["install-service"], "no command 'install-service'; type companion service install"),
        (["statsu"], "no command 'statsu'; did you mean status?"),
        (["frobnicate"], "no command 'frobnicate' (see"),
        (["calibrate", "--wiat"], "unknown option --wiat; did you mean --wait?"),
        (["calibrate", "--gyro"], "unknown option --gyro; did you mean --gyros?"),
        (["align", "--show"], "--show was removed in 0.3: type companion align show"),
        (["check", "--seconds", "1"], "found '1'; allowed: a number from 3 to 600"),
    ],
)
def test_a_wrong_word_leads_to_the_right_one(words: list[str], answer: str, capsys: Captured) -> None:
    line = said(words, capsys)
    assert answer in line
    assert line.count("\n") == 1


def test_commands_in_answers_name_the_configuration_that_was_named(capsys: Captured) -> None:
    assert cli.main(["-c", "my own.toml", "explain", "sensor_silent: no reading from gradienter"]) == 0
    assert "Type `companion -c 'my own.toml' check`" in capsys.readouterr().out
    cli.main(["explain", "no reading from gradienter"])
    assert "Type `companion check`" in capsys.readouterr().out


def test_the_stored_history_is_read_without_a_daemon_and_without_damaged_files(
    tmp_path: Path, capsys: Captured
) -> None:
    file, storage = tmp_path / "c.toml", tmp_path / "state"
    storage.mkdir()
    RecordStore(storage).save(record())
    armings_in(storage)._file.path.write_bytes(b"{")
    file.write_text(
        '[mavlink]\nurl = "tcp:h:1"\n[[imu]]\nname = "a"\nsource = "autopilot"\n'
        f'[control]\nsocket = "{tmp_path}/s"\n[storage]\ndirectory = "{storage}"\n'
    )
    assert cli.main(["-c", str(file), "history"]) == 0
    told = capsys.readouterr()
    assert record().reason in told.out
    assert "the stored history" in told.err


@pytest.mark.parametrize(
    ("outcomes", "claim"),
    [
        ([], "The autopilot has its old values."),
        (["rolled_back", "rolled_back"], "The autopilot has its old values."),
        (["rolled_back", "failed"], "Some parameters may hold neither the old nor the new value"),
        (["verified", "stored"], "2 parameters written to the autopilot"),
    ],
)
def test_a_result_claims_only_what_is_known_of_the_autopilot(outcomes: list[str], claim: str) -> None:
    written = {f"P{k}": {"before": 0.0, "after": 1.0, "outcome": outcome} for k, outcome in enumerate(outcomes)}
    imu = {
        "name": "fc", "samples": 1, "temperature_degc": None, "gyro_bias_rad_s": None, "accel_bias_m_s2": None,
        "written": written, "warnings": [],
    }  # fmt: skip
    found = {"state": "failed", "duration_s": 1.0, "reason": "x", "imus": [imu], "warnings": []}
    assert show.record_lines(found)[-1].startswith(claim)
