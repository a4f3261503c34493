"""`companion align` without a daemon: its usage, its exit codes, and how a kept alignment survives."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from companion import cli, config
from companion.cli.client import pose_lines
from companion.cli.setup import next_steps
from companion.estimation.records.align_record import AlignmentRecord, GradienterSettings
from companion.storage.records import alignment_in

CONFIG = '[mavlink]\nurl = "tcp:h:1"\n[[imu]]\nname = "a"\nsource = "autopilot"\n[control]\nsocket = "{}"\n'
RECORD = AlignmentRecord(
    kind="zero",
    measured_at="2026-11-21T21:24:42.236+00:00",
    gradienter=GradienterSettings(
        port="/dev/g", protocol="inclinometer_xy", law="slope", mounting=(0.0, 0.0, 90.0), offset_deg=(0.01, 0.02)
    ),
    offset_deg=(0.11, -0.05),
    sigma_deg=0.0125,
    covariance_deg2=((1.5e-4, 0.0), (0.0, 1.5e-4)),
    slope_deg=0.5,
    checked=True,
    chi_square=9.8,
    freedom=31,
    temperature_degc=None,
    stands=(),
    imus=(),
)


@pytest.mark.parametrize("words", [[], ["zero", "--show"], ["zero", "--headings", "5"], ["zero", "--timeout", "-1"]])
def test_usage(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["align", *words])
    assert end.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_no_daemon(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The advice starts this daemon: with the named file, or the service where there is one."""
    file = tmp_path / "my c.toml"
    file.write_text(CONFIG.format(tmp_path / "none.sock"), encoding="utf-8")
    assert cli.main(["-c", str(file), "align", "zero", "--json"]) == 3
    told = capsys.readouterr()
    assert json.loads(told.out)["state"] == "unreachable"
    line, remedy = told.err.splitlines()
    assert line.endswith(f"(no such socket); start it with: companion -c '{file}' run")
    assert remedy.startswith("-> Start the companion as the line says.")
    monkeypatch.setattr(config, "DEFAULT_PATH", file)
    for serves, start in ((False, "companion run"), (True, "sudo systemctl start companion")):
        monkeypatch.setattr("companion.installation.install.is_service", lambda serves=serves: serves)
        assert cli.main(["status"]) == 3
        assert capsys.readouterr().err.splitlines()[0].endswith(f"; start it with: {start}")


def test_a_zero_is_shown_with_the_acceleration_that_its_sigma_is_worth() -> None:
    # 0.0125 deg of g.
    assert any("0.22 mg" in line for line in pose_lines(msgspec.to_builtins(RECORD)))


def test_the_set_up_asks_for_a_zero_only_where_none_is_kept(tmp_path: Path) -> None:
    gradienter = '[gradienter]\nport = "/dev/g"\nprotocol = "inclinometer_xy"\nlaw = "slope"\n'
    gradienter += f'mounting = [0, 0, 90]\noffset_deg = [0.01, 0.02]\n[storage]\ndirectory = "{tmp_path}"\n'
    parsed = config.parse(CONFIG.format(tmp_path / "none.sock") + gradienter, "file")

    def steps() -> str:
        return "\n".join(next_steps(parsed, "companion", is_old=False, runs=True, good=True, checks=True))

    assert "align zero" in steps()
    alignment_in(tmp_path).write(RECORD)
    assert "align zero" not in steps()
    alignment_in(tmp_path).write(
        msgspec.structs.replace(
            RECORD,
            gradienter=GradienterSettings(
                port="/dev/g",
                protocol="inclinometer_xy",
                law="axis",
                mounting=(0.0, 0.0, 90.0),
                offset_deg=(0.01, 0.02),
            ),
        )
    )
    assert "align zero" in steps()
