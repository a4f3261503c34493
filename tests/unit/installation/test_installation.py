"""`companion service install` below a folder of its own: what is put where, what is left alone, what goes away."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

from companion import cli
from companion.errors import CompanionError
from companion.installation import install as installation
from companion.installation import install as installing
from companion.installation.install import Installation, install, uninstall, unreachable

UNIT = "usr/local/lib/systemd/system/companion.service"
FIRST_RUN = "usr/local/lib/systemd/system/companion-setup.service"
RULES = "usr/local/lib/udev/rules.d/70-companion.rules"
MODULES = "usr/local/lib/modules-load.d/companion.conf"
CONFIGURATION = "etc/companion/companion.toml"
SAMPLE = CONFIGURATION + ".sample"
EXECUTABLE = "/opt/elsewhere/bin/companion"
SYSTEMD_ANALYZE = shutil.which("systemd-analyze") or ""
needs_systemd_analyze = pytest.mark.skipif(
    not SYSTEMD_ANALYZE, reason="systemd-analyze is not here (Debian: apt-get install systemd)"
)


def target(root: Path, *, executable: str = EXECUTABLE) -> Installation:
    return Installation(root, Path("/usr/local"), executable)


def outcomes(root: Path, steps: Sequence[object]) -> dict[str, str]:
    return {str(Path(step.what).relative_to(root)): step.outcome for step in steps}  # type: ignore[attr-defined]


def tree(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_everything_is_put_in_place_once(tmp_path: Path) -> None:
    first = outcomes(tmp_path, list(install(target(tmp_path))))
    assert first == {**dict.fromkeys((UNIT, FIRST_RUN, RULES, MODULES, SAMPLE), "written"), CONFIGURATION: "absent"}
    placed = tree(tmp_path)
    assert placed.keys() == first.keys() - {CONFIGURATION}
    assert f"ExecStart={EXECUTABLE} -c /etc/companion/companion.toml run\n" in placed[UNIT].decode()
    assert f"ExecStart={EXECUTABLE} setup --page 0.0.0.0:8191\n" in placed[FIRST_RUN].decode()
    assert all(stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o644 for name in placed)
    again = outcomes(tmp_path, list(install(target(tmp_path))))
    assert set(again.values()) == {"unchanged", "absent"}
    assert tree(tmp_path) == placed


def test_what_its_owner_has_changed_is_kept_and_the_rest_brought_up_to_date(tmp_path: Path) -> None:
    list(install(target(tmp_path)))
    (tmp_path / CONFIGURATION).write_text("[mavlink]\n")
    with (tmp_path / RULES).open("a") as rules:
        rules.write("# mine\n")
    again = outcomes(tmp_path, list(install(target(tmp_path, executable="/opt/companion/bin/companion"))))
    new = dict.fromkeys((UNIT, FIRST_RUN), "updated")
    assert again == {**new, RULES: "kept", MODULES: "unchanged", SAMPLE: "unchanged", CONFIGURATION: "kept"}
    assert (tmp_path / CONFIGURATION).read_text() == "[mavlink]\n"
    assert (tmp_path / RULES).read_text().endswith("# mine\n")
    gone = outcomes(tmp_path, list(uninstall(target(tmp_path))))
    assert gone.pop(RULES) == gone.pop(CONFIGURATION) == "kept"
    assert gone == dict.fromkeys((UNIT, FIRST_RUN, MODULES, SAMPLE), "removed")
    assert tree(tmp_path).keys() == {RULES, CONFIGURATION}


def test_uninstalling_leaves_nothing_and_can_be_repeated(tmp_path: Path) -> None:
    list(install(target(tmp_path)))
    assert set(outcomes(tmp_path, list(uninstall(target(tmp_path)))).values()) == {"removed", "absent"}
    assert tree(tmp_path) == {}
    assert set(outcomes(tmp_path, list(uninstall(target(tmp_path)))).values()) == {"absent"}


def test_a_path_that_cannot_stand_in_a_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CompanionError, match="allowed: an absolute path without spaces"):
        list(install(target(tmp_path, executable="/opt/my companion/bin/companion")))


def test_what_the_service_could_not_reach_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert unreachable(Path("/usr/bin/env")) is None
    assert (
        unreachable(Path("/home/pi/companion")) == "/home/pi/companion is below /home, where the service may not look"
    )
    closed = tmp_path / "closed"
    (closed / "bin").mkdir(parents=True)
    closed.chmod(0o700)
    monkeypatch.setattr(installation, "HIDDEN", ())  # pytest's own folders are below /tmp
    assert unreachable(closed / "bin") == f"{closed} is closed to everybody but its owner (mode 0700)"


def test_the_command_says_line_by_line_what_it_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["service", "install", "--root", str(tmp_path), "--prefix", "/usr", "--executable", EXECUTABLE]
    assert cli.main([*words, "--json"]) == 0
    told = capsys.readouterr()
    assert f"written    {tmp_path}/usr/lib/systemd/system/companion.service" in told.err.splitlines()
    answer = json.loads(told.out)
    assert answer["state"] == "done"
    assert [step["outcome"] for step in answer["steps"]] == [*["written"] * 5, "absent"]
    assert cli.main(["service", "remove", "--root", str(tmp_path), "--prefix", "/usr"]) == 0
    assert capsys.readouterr().out.count("removed    ") == 5


def test_without_root_this_machine_is_left_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert cli.main(["service", "install"]) == 1
    assert "this needs root: sudo " in capsys.readouterr().err


def test_the_service_of_a_debian_package_is_left_to_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / installation.PACKAGED).write_text("apt\n")
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    for command, instead in (
        ("install", "sudo systemctl enable --now companion"),
        ("remove", "sudo apt remove companion"),
    ):
        assert cli.main(["service", command]) == 1
        assert capsys.readouterr().err.strip().endswith(f"is a Debian package, and its service came with it: {instead}")


def test_the_files_are_found_in_a_checkout_and_in_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = Path(installing.__file__).parents[2]
    assert installing.folder() == project / "systemd"
    building = tomllib.loads((project / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]
    ((source, place),) = building["wheel"]["force-include"].items()
    shutil.copytree(project / source, tmp_path / place)
    assert source in building["sdist"]["include"]
    monkeypatch.setattr(installing, "__file__", str(tmp_path / "companion/installation/install.py"))
    assert installing.folder() == tmp_path / "companion/installation/systemd"
    shutil.rmtree(tmp_path / place)
    with pytest.raises(CompanionError, match="the installation is not complete"):
        installing.folder()


# --- what systemd says to it


@pytest.mark.real_clock
@needs_systemd_analyze
def test_systemd_finds_nothing_wrong_with_the_units(tmp_path: Path) -> None:
    list(install(target(tmp_path, executable="/bin/true")))
    units = [str(tmp_path / unit) for unit in (UNIT, FIRST_RUN)]
    verified = subprocess.run(
        [SYSTEMD_ANALYZE, "verify", "--man=no", *units], capture_output=True, text=True, check=False
    )
    assert (verified.returncode, verified.stdout, verified.stderr) == (0, "", "")


@pytest.mark.real_clock
@needs_systemd_analyze
def test_the_exposure_of_the_unit(tmp_path: Path) -> None:
    list(install(target(tmp_path, executable="/bin/true")))
    command = [SYSTEMD_ANALYZE, "security", "--offline=true", "--json=short", "--threshold=20", str(tmp_path / UNIT)]
    rated = subprocess.run(command, capture_output=True, text=True, check=False)
    # The threshold is the overall exposure times ten; above it the exit code is not 0.
    assert rated.returncode == 0, rated.stdout + rated.stderr
    # That it judges at all: the same unit without its hardening is far above.
    bare = tmp_path / "bare.service"
    bare.write_text("[Service]\nExecStart=/bin/true\n")
    assert subprocess.run([*command[:-1], str(bare)], capture_output=True, check=False).returncode != 0


def test_the_unit_keeps_trying_and_asks_for_nothing_newer_than_systemd_252() -> None:
    settings = [
        line.partition("=")
        for line in installing.content(installing.SERVICE).decode().splitlines()
        if "=" in line and not line.startswith("#")
    ]
    values: dict[str, list[str]] = {}
    for key, _, value in settings:
        values.setdefault(key, []).append(value)
    assert values["Restart"] == ["always"]
    assert values["StartLimitIntervalSec"] == ["0"]
    assert values["Type"] == ["notify"]
    assert not {"RestartSteps", "RestartMaxDelaySec", "MemoryKSM", "DelegateSubgroup"} & values.keys()
    # Classes, never paths: a path would mean one device number, and a port plugged in again has another.
    assert {"char-ttyUSB rw", "char-ttyACM rw", "char-ttyAMA rw", "char-ttyS rw"} <= set(values["DeviceAllow"])
    assert all(value.startswith("char-") for value in values["DeviceAllow"])
    # Each class that a driver brings later has its driver loaded before us.
    modules = installing.content(installing.MODULES).decode().splitlines()
    assert {"usbserial", "cdc_acm"} <= set(modules)
    assert any("systemd-modules-load.service" in value for value in values["After"])
