"""The page over TLS: only with a pair that can be used, and with a renewed one without a restart."""

from __future__ import annotations

import asyncio
import datetime
import logging
import ssl
from collections.abc import Callable
from pathlib import Path

import pytest
import trustme

from companion.cli import main as companion
from companion.errors import ConfigError
from companion.fleet.server import Certificate
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW, get, served

AUTHORITY = trustme.CA()
DAY = datetime.timedelta(days=1)


def issue(folder: Path, name: str = "page", days: tuple[int, int] = (-10, 10)) -> tuple[Path, Path]:
    """A certificate for 127.0.0.1, good from one day to the other, and its key."""
    now = datetime.datetime.now(tz=datetime.UTC)
    since, until = now + days[0] * DAY, now + days[1] * DAY
    one = AUTHORITY.issue_cert("127.0.0.1", common_name=name, not_before=since, not_after=until)
    cert, key = folder / f"{name}.pem", folder / f"{name}.key"
    one.cert_chain_pems[0].write_to_path(cert)
    one.private_key_pem.write_to_path(key)
    return cert, key


def trusting() -> ssl.SSLContext:
    context = ssl.create_default_context()
    AUTHORITY.configure_trust(context)
    return context


async def shown(port: int) -> str:
    """The common name of the certificate that the page shows."""
    _, writer = await asyncio.open_connection("127.0.0.1", port, ssl=trusting())
    try:
        (subject,) = (
            value for ((key, value), *_) in writer.get_extra_info("peercert")["subject"] if key == "commonName"
        )
        return str(subject)
    finally:
        writer.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30.0):
        while not condition():
            await asyncio.sleep(0.01)


def test_a_renewed_certificate_is_taken_and_one_that_cannot_be_used_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("companion.fleet.server.CERTIFICATE_S", 0.02)
    caplog.set_level(logging.INFO)
    cert, key = issue(tmp_path)
    renewed, its_key = issue(tmp_path, "renewed")
    one = Aircraft(1)
    one.calibrate(NOW)

    def said(words: str) -> Callable[[], bool]:
        return lambda: caplog.text.count(words) == 1

    async def main() -> None:
        async with served(tmp_path, one, certificate=Certificate(cert, key)) as port:
            status, answer = await get(port, tls=trusting())
            assert status == 200
            assert one.name in answer
            with pytest.raises((ConnectionError, IndexError)):
                await get(port)  # plain
            assert await shown(port) == "page"
            renewed.replace(cert)
            await until(said(f"the former certificate is used: {key}: not usable: key values mismatch"))
            assert await shown(port) == "page"
            its_key.replace(key)
            await until(said(f"{cert} was taken anew"))
            assert await shown(port) == "renewed"
            key.unlink()
            await until(said(f"the former certificate is used: {key}: no such file"))
            assert await shown(port) == "renewed"

    asyncio.run(main())


def test_what_cannot_be_used_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cert, key = issue(tmp_path)
    _, other = issue(tmp_path, "other")
    text, none = tmp_path / "text", tmp_path / "none"
    text.write_text("not a certificate")
    for pair, words in (
        ((none, key), f"{none}: no such file"),
        ((cert, none), f"{none}: no such file"),
        ((text, key), f"{text}: not usable: "),
        ((key, key), f"{key}: not usable: "),
        ((cert, text), f"{text}: not usable: "),
        ((cert, other), f"{other}: not usable: key values mismatch"),
    ):
        with pytest.raises(ConfigError) as caught:
            Certificate(*pair)
        assert str(caught.value).startswith(words)
        assert "\n" not in str(caught.value)
    for more, words in (
        (["--cert", str(cert)], "--cert and --key: found one of them"),
        (["--cert", str(cert), "--key", str(other)], "key values mismatch"),
    ):
        assert companion(["fleet", "run", "--database", str(tmp_path / "fleet.sqlite"), *more]) == 2
        assert words in capsys.readouterr().err
