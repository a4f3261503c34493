"""`companion setup` at a terminal and by a script: simulated devices on UARTs, both autopilots on UDP and on a wire."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import socket
import sys
import tomllib
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import pytest

from companion import cli, config
from companion.installation import install as installing
from sim.aircraft import VirtualAircraft
from sim.firmware.double import AutopilotDouble
from sim.hands import AHEAD_S, Hands
from sim.pty_device import PtyDevice, Setting, heard, reader_setting
from sim.scenario import demo
from sim.station import open_udp
from tests.support.chatter import Chatter
from tests.support.terminal import CTRL_C, CTRL_D, Terminal

pytestmark = pytest.mark.real_clock

Firmware = Literal["ardupilot", "px4"]
LINES = {"gradienter": Setting(9600, "none"), "compass": Setting(19200, "none"), "imu": Setting(115200, "none")}


def free_udp() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


UNKNOWN_PARTS = {f"INS_{half}{number}_ID": 0x3A0002 for half in ("GYR", "ACC") for number in ("", "2")}
"""Device ids of parts that the catalogue has not."""


class SetupBench:
    """Simulated devices on ports below a folder, an autopilot, and how to call the command."""

    def __init__(self, folder: Path, aircraft: VirtualAircraft | None = None) -> None:
        self.folder, self.file, self.udp = folder, folder / "companion.toml", free_udp()
        self.told: list[bytes] = []
        """Everything sent to the autopilot."""
        self.aircraft = aircraft

    def words(self, *ports: str, silent: int = 0) -> list[str]:
        """Arguments: these ports, and the autopilot's UDP port or one where nobody is."""
        paths = [str(self.folder / port) for port in ports]
        return ["-c", str(self.file), "setup", *paths, "--udp", str(silent or self.udp)]

    def configuration(self) -> dict[str, Any]:
        return tomllib.loads(self.file.read_text())

    def left(self) -> set[str]:
        """Files beside the ports."""
        return {path.name for path in self.folder.iterdir() if path.is_file() and path.name not in LINES}


@contextlib.asynccontextmanager
async def bench(
    folder: Path,
    *,
    firmware: Firmware = "ardupilot",
    on_wire: bool = False,
    parameters: Mapping[str, float] = MappingProxyType({}),
    answers_after_s: float = 0.0,
) -> AsyncIterator[SetupBench]:
    """The demonstration's aircraft: devices as from the factory, the autopilot on UDP or on a serial port."""
    scenario = demo(firmware=firmware)
    made = SetupBench(folder, scenario.aircraft)
    loop = asyncio.get_running_loop()
    scenario.aircraft.begin(loop.time())
    autopilot, receive = scenario.autopilot, scenario.autopilot.receive
    for name, value in {**(UNKNOWN_PARTS if firmware == "ardupilot" else {}), **parameters}.items():
        autopilot.set_parameter(name, value)

    def told(data: bytes, t_s: float) -> None:
        made.told.append(data)
        loop.call_later(answers_after_s, receive, data, t_s + answers_after_s)

    autopilot.receive = told  # type: ignore[method-assign]
    async with contextlib.AsyncExitStack() as stack:
        for name, device in scenario.ports.items():
            await stack.enter_async_context(PtyDevice(device, folder / name, line=LINES[name]))
        if on_wire:
            await stack.enter_async_context(wired(autopilot, folder / "telem", Setting(57600, "none")))
        else:
            stack.callback((await open_udp(autopilot, target=("127.0.0.1", made.udp))).close)
        running = asyncio.create_task(autopilot.run())
        try:
            yield made
        finally:
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running


@contextlib.asynccontextmanager
async def wired(autopilot: AutopilotDouble, path: Path, line: Setting) -> AsyncIterator[None]:
    """The autopilot's telemetry port as a UART of this speed."""
    wire = Chatter(path, lambda _: b"")
    wire.plug(path)
    loop = asyncio.get_running_loop()

    def send(data: bytes) -> None:
        with contextlib.suppress(OSError):
            os.write(wire.master, heard(data, line, reader_setting(wire.master)))

    async def listen() -> None:
        while True:
            with contextlib.suppress(OSError):
                autopilot.receive(os.read(wire.master, 4096), loop.time())
            await asyncio.sleep(0.01)

    autopilot.attach(send)
    listening = asyncio.create_task(listen())
    try:
        yield
    finally:
        listening.cancel()
        autopilot.attach(None)
        wire.unplug()


async def answered(terminal: Terminal, *answers: str) -> None:
    """Each of the five questions, in their order."""
    questions = ("on the ground", "axis, slope, euler or test", "gradienter turned", "compass turned", "own IMU turned")
    for question, words in zip(questions, answers, strict=True):
        await terminal.answer(question, words)


async def by_script(made: SetupBench, *words: str) -> tuple[int, Any, str]:
    """Exit code, the JSON object, and what people are told."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", *words, "--yes", "--json",
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}, cwd=made.folder,
    )  # fmt: skip
    out, err = await process.communicate()
    return await process.wait(), json.loads(out) if out else None, err.decode()


async def test_a_person_answers_and_has_a_configuration_that_works(tmp_path: Path) -> None:
    async with bench(tmp_path) as made, Terminal(made.words(*LINES), tmp_path) as terminal:
        said = await terminal.says("Ctrl-C ends")
        assert made.told == [], "it only listens"
        assert f"UDP {made.udp}: ArduPilot, system 1" in said
        await answered(terminal, "", "eu", "180", "0", "yaw 90")
        await terminal.says("IMU 1: its device id tells no part of the catalogue")
        await terminal.answer("It has IMU 2 too", "")
        await terminal.answer(r"IMU 1 of the autopilot \(fc\).*adis16470 13", "ICM-42688-P")
        await terminal.answer(r"the own IMU \(own\)", "bmi")
        await terminal.answer(r"IMU 2 of the autopilot \(fc2\)", "")
        assert made.left() == set()
        shown = await terminal.says(r"Write it\?")
        assert 'law = "euler"' in shown
        await terminal.answer("", "")
        checked = await terminal.says("Next:")
        assert await terminal.ended() == 0, terminal.screen
        assert not re.search("^wrong", checked, re.MULTILINE)
        assert "calibrate" in terminal.screen
        assert "align zero   (once: the gradienter's zero; until then accelerometers to 0.9 mg)" in terminal.screen
        assert made.configuration()["mavlink"]["url"] == f"udpin:127.0.0.1:{made.udp}"
        assert made.configuration()["gradienter"] == {
            "port": str(tmp_path / "gradienter"), "protocol": "inclinometer_xy", "law": "euler", "baud": 9600,
            "parity": "none", "mounting": "ROTATION_YAW_180",
        }  # fmt: skip
        assert made.configuration()["compass"]["protocol"] == "hmr3300"
        assert made.configuration()["compass"]["baud"] == 19200
        first, own, second = made.configuration()["imu"]
        assert own["mounting"] == "ROTATION_YAW_90"
        assert (first["source"], second) == ("autopilot", {"name": "fc2", "source": "autopilot", "instance": 2})
        assert (first["profile"], own["profile"]) == ("icm42688p", "bmi088")
        assert re.search("^ok +profile fc +icm42688p", checked, re.MULTILINE)
        assert re.search("^warning +profile +fc2: part unknown: its noise is learned at rest", checked, re.MULTILINE)
        assert re.search(r"ok +fc2 +autopilot IMU 2", checked), "what is there, and nothing of the third"
        assert "IMU 3" not in terminal.screen
        assert made.left() == {"companion.toml"}


async def test_a_script_has_gyros_of_an_autopilot_on_a_wire_alone(tmp_path: Path) -> None:
    async with bench(tmp_path, firmware="px4", on_wire=True) as made:
        code, answer, told = await by_script(made, *made.words("telem"), "--platform", "deck")
        assert answer["heard"][str(tmp_path / "telem")] == "PX4, system 1 (57600 8N1)"
        assert code == 0, told
        assert made.configuration()["mavlink"]["url"] == f"serial:{tmp_path}/telem:57600"
        assert made.configuration()["vehicle"]["platform"] == "deck"
        assert made.configuration().keys() & {"gradienter", "compass"} == set()
        assert (answer["state"], answer["reason"], answer["guessed"]) == (
            "done",
            "",
            ["imu.fc.profile", "imu.fc2.profile"],
        )
        assert [finding["name"] for finding in answer["findings"] if not finding["good"]] == []
        assert "no gradienter: gyros only" in told.lower()
        assert [imu["name"] for imu in made.configuration()["imu"]] == ["fc", "fc2"]
        assert made.configuration()["storage"]["directory"] == str(tmp_path / "companion-state")
        assert answer["next"][-1].split("   ")[0] == f"companion -c {made.file} calibrate"


@pytest.mark.parametrize("at", [0, 3, 10])
async def test_whoever_ends_it_at_any_question_leaves_all_as_it_was(tmp_path: Path, at: int) -> None:
    async with bench(tmp_path) as made, Terminal(made.words(*LINES), tmp_path) as terminal:
        if at:
            await terminal.says("Ctrl-C ends")
            for _ in range(at - 1):
                await terminal.answer("")
            await terminal.says("> ")
            terminal.types(CTRL_D if at == 3 else CTRL_C)
        else:
            await terminal.says("Listening")
            terminal.types(CTRL_C)
        assert await terminal.ended() == 1, terminal.screen
        await terminal.says("nothing was written")
        assert "Traceback" not in terminal.screen
        assert made.left() == set()
        assert made.told == [] or at > len(LINES) + 2, "the autopilot is asked after these questions"


async def test_bad_answers_get_one_line_each_and_are_asked_again(tmp_path: Path) -> None:
    async with bench(tmp_path) as made, Terminal([*made.words("gradienter"), "--no-check"], tmp_path) as terminal:
        for question, *bad in (
            ("on the ground", "water"),
            ("axis, slope, euler or test", "x" * 3000, "\x1b[2J"),
            ("gradienter turned", "90 0", "ROTATION_ROLL_180"),
            ("Which part", "mpu6000", "adis", "\x00"),
            (r"Write it\?", "perhaps"),
        ):
            await terminal.says(f"(?s){question}.*?> ")
            for words in bad:
                terminal.types(f"{words}\n")
                complaint = await terminal.says("\n  .*found .*; allowed.*\n")
                assert len(complaint.splitlines()[-1]) < 250
                await terminal.says("> ")
            terminal.types("\n" if "test" not in question else "axis\n")
        assert await terminal.ended() == 0
        assert made.configuration()["gradienter"]["law"] == "axis"


async def test_again_it_reads_what_is_there_and_keeps_the_old_file(tmp_path: Path) -> None:
    async with bench(tmp_path) as made:
        first = [*made.words("gradienter"), "--no-check"]
        assert (await by_script(made, *first, "--law", "slope"))[0] == 0
        made.file.write_text(made.file.read_text().replace('"slope"', '"slope"  # by two positions') + "# mine\n")
        made.file.chmod(0o600)
        before = made.file.read_bytes()
        code, answer, _ = await by_script(made, *first)
        assert (code, answer["state"], answer["kept"]) == (0, "unchanged", None)
        assert made.file.read_bytes() == before
        async with Terminal(first, tmp_path) as terminal:
            await terminal.answer("on the ground", "deck")
            await terminal.answer("axis, slope, euler or test")
            await terminal.answer("gradienter turned")
            await terminal.answer("Which part")
            await terminal.answer(r"Write it\?")
            assert await terminal.ended() == 0, terminal.screen
        assert made.configuration()["vehicle"]["platform"] == "deck"
        assert 'law = "slope"  # by two positions\n' in made.file.read_text()
        assert made.file.read_text().endswith("# mine\n")
        assert made.file.stat().st_mode & 0o777 == 0o600
        assert made.file.with_name("companion.toml.old1").read_bytes() == before
        assert made.left() == {"companion.toml", "companion.toml.old1"}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "no autopilot was heard"),
        (["--mavlink", "udpin:nowhere"], "'mavlink.url': found 'udpin:nowhere'"),
        (["--mavlink", "udpin:0.0.0.0:14550", "--law", "round"], "gradienter.law: found 'round'"),
        (["--mavlink", "udpin:0.0.0.0:14550", "--law", "axis"], "gradienter.law: there is no such device"),
        (["--mavlink", "udpin:0.0.0.0:14550", "--mounting", "hat=90"], "--mounting: found 'hat=90'"),
        (["--mavlink", "udpin:0.0.0.0:14550", "--part", "fc=mpu6000", "--no-check"], "imu.fc.profile: found 'mpu6000'"),
    ],
)
async def test_a_script_that_cannot_go_on_writes_nothing(tmp_path: Path, words: list[str], reason: str) -> None:
    made = SetupBench(tmp_path)
    code, _, told = await by_script(made, *made.words("nobody"), *words)
    assert code in (1, 2)
    assert reason in told.splitlines()[-1]
    assert told.splitlines()[-1].endswith("nothing was written")
    assert made.left() == set()


async def test_a_law_that_nothing_tells_is_not_guessed(tmp_path: Path) -> None:
    async with bench(tmp_path) as made:
        code, _, told = await by_script(made, *made.words("gradienter"), "--no-check")
        assert code == 2
        assert "inclinometer_xy does not tell; name it by --law" in told.splitlines()[-1]
        assert made.left() == set()
    async with bench(tmp_path) as made, Terminal([*made.words("gradienter"), "--no-check"], tmp_path) as terminal:
        await terminal.answer("on the ground", "?")
        await terminal.says("a boat, a dock")
        await terminal.answer("", "boat")
        await terminal.answer("axis, slope, euler or test")
        await terminal.says("found ''; allowed: axis, slope, euler, test")


async def test_two_tilts_tell_the_law_and_a_tilt_beyond_the_range_is_led_back(tmp_path: Path) -> None:
    async with bench(tmp_path) as made, Terminal([*made.words("gradienter"), "--no-check"], tmp_path) as terminal:
        assert made.aircraft is not None
        aircraft, hands, loop = made.aircraft, Hands(made.aircraft, takes_s=2.0), asyncio.get_running_loop()

        def hold(pitch_deg: float, roll_deg: float) -> None:
            hands.hold(aircraft.time_at(loop.time()) + AHEAD_S, pitch_deg, roll_deg)

        await terminal.answer("on the ground")
        await terminal.answer("axis, slope, euler or test", "test")
        await terminal.says("Nose up 5 deg: 15 deg more; right side down -3 deg: 23 deg more")
        hold(33.0, 26.0)
        await terminal.says("Nose up 33 deg: 15 deg back; .* The gradienter gives no reading: over its range")
        hold(18.0, 18.0)
        await terminal.says("Tilt 1 is measured")
        hold(-20.0, -20.0)
        await terminal.says("Tilt 2 is measured")
        await terminal.says("The gradienter reads axis, and is turned by 0 deg")


@pytest.mark.parametrize("works", [True, False])
def test_the_service_is_started_with_it(
    works: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a stand-in for systemctl, as after `apt install`; a real systemd is in test_under_systemd.py."""
    systemctl, told = tmp_path / "systemctl", tmp_path / "told"
    systemctl.write_text(f'#!/bin/sh\necho "$@" >>{told}\n' + ("" if works else "echo no such unit >&2; exit 5\n"))
    systemctl.chmod(0o755)
    (tmp_path / installing.PACKAGED).touch()
    monkeypatch.setattr(installing, "systemd_runs", lambda: True)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(config, "DEFAULT_PATH", tmp_path / "companion.toml")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    words = ["setup", str(tmp_path / "nobody"), "--mavlink", "udpin:127.0.0.1:14550", "--udp", str(free_udp())]
    code = cli.main([*words, "--yes", "--json", "--no-check"])
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert told.read_text().splitlines() == ["enable companion.service", "restart companion.service"]
    assert "Start the companion now, and at every boot: yes" in err
    if works:
        assert (code, answer["state"]) == (0, "done")
        assert [step["outcome"] for step in answer["steps"]] == ["done", "done"]
        assert not any("systemctl" in step for step in answer["next"])
    else:
        assert (code, answer["state"]) == (1, "failed")
        assert answer["reason"] == "; ".join(
            f"systemctl {verb} companion.service: no such unit" for verb in ("enable", "restart")
        )
        assert answer["next"][0].startswith("sudo systemctl enable --now companion ")


async def test_a_damaged_file_is_not_replaced_unasked(tmp_path: Path) -> None:
    made = SetupBench(tmp_path)
    made.file.write_text("[mavlnk]\n")
    code, _, told = await by_script(made, *made.words("nobody"), "--mavlink", "udpin:0.0.0.0:14550")
    assert code == 2
    assert "did you mean 'mavlink'?; nothing was written" in told
    async with Terminal([*made.words("nobody"), "--mavlink", "udpin:0.0.0.0:14550", "--no-check"], tmp_path) as one:
        await one.answer("Begin anew", "yes")
        await one.answer("on the ground")
        await one.answer("Which part")
        await one.answer(r"Write it\?")
        assert await one.ended() == 0
    assert made.configuration()["mavlink"]["url"] == "udpin:0.0.0.0:14550"
    assert made.file.with_name("companion.toml.old1").read_text() == "[mavlnk]\n"
