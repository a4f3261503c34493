"""What a broker may send and what not, and what the worst of them costs."""

from __future__ import annotations

import asyncio
import itertools
import re
import ssl
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import trustme

from companion.config.sections import Mqtt
from companion.links.mqtt import filter as mqtt_filter
from companion.links.mqtt.client import Incoming, MqttLink
from companion.links.mqtt.filter import BrokerFaultError, MqttFilter, NoGreetingError
from tests.support.hostile_broker import Attack, HostileBroker, huge, packet, publish, variable

STATUS, REQUESTS = "companion/7/status", "companion/7/request/+"
REQUEST = b"companion/7/request/calibrate"
CONNACK = packet(0x20, b"\0\0\0")
USER_PROPERTY = b"\x26\0\1a\0\1b"
MOST_ALLOCATED_BYTES = 8_000_000
"""Far more than the link needs, the broker of the test included, and far less than any attack sends."""


async def at_once(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


async def passed(sent: bytes, protocol: int = 5) -> tuple[bytes, BaseException | None]:
    """What the library gets of what a broker sends before it ends the connection; and what was found fault with."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(sent)
        writer.write_eof()
        await reader.read()
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        async with MqttFilter("127.0.0.1", server.sockets[0].getsockname()[1], None, protocol) as broker:
            reader, writer = await asyncio.open_unix_connection(broker.address)
            writer.write(packet(0x10))
            got = await reader.read()
            writer.close()
        return got, broker.fault


@pytest.mark.parametrize("protocol", [4, 5])
def test_what_a_broker_has_to_say_passes(protocol: int) -> None:
    none = b"\0" if protocol == 5 else b""
    said = b"".join(
        [
            packet(0x20, b"\0\0" + none),
            packet(0x90, b"\0\1" + none + b"\1"),
            packet(0x31, b"\0\1a" + none + b"payload"),
            packet(0x3A, b"\0\2\xc3\xa9\0\7" + none),
            packet(0x31, b"\0\1a" + none + bytes(mqtt_filter.MAX_PACKET_BYTES - 3 - len(none))),
            packet(0x40, b"\0\7"),
            packet(0xD0),
            packet(0xE0, b"\x8e" * (protocol == 5)),
        ]
    )
    assert asyncio.run(passed(said, protocol)) == (said, None)


def test_the_library_gets_no_properties_but_those_of_the_greeting() -> None:
    many = USER_PROPERTY * 1000
    long = variable(len(many)) + many
    greeting = packet(0x20, b"\0\0" + variable(21) + USER_PROPERTY * 3)
    sent = [
        publish(b"a", b"payload", qos=1, number=7, properties=many),
        publish(b"a", properties=many),
        packet(0x40, b"\0\7\x10" + long),
        packet(0x90, b"\0\1" + long + b"\1"),
        packet(0xE0, b"\x8e" + long),
    ]
    wanted = [
        publish(b"a", b"payload", qos=1, number=7),
        publish(b"a"),
        packet(0x40, b"\0\7\x10\0"),
        packet(0x90, b"\0\1\0\1"),
        packet(0xE0, b"\x8e\0"),
    ]
    assert asyncio.run(passed(greeting + b"".join(sent))) == (greeting + b"".join(wanted), None)


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (b"\x30" + variable(250_000_000), "a message of 250 MB; at most 64 kB are taken"),
        (b"\x30" + variable(65537), "a message of 65.5 kB; at most 64 kB are taken"),
        (b"\x90" + variable(268_435_455), "a message of 268 MB; at most 64 kB are taken"),
        (b"\x30\xff\xff\xff\xff", "a packet whose length has no end"),
        (publish(b"a", qos=2), "a packet that nobody asked for (0x34)"),
        (packet(0x62, b"\0\1"), "a packet that nobody asked for (0x62)"),
        (packet(0xC0), "a packet that nobody asked for (0xc0)"),
        (CONNACK, "a packet that nobody asked for (0x20)"),
        (publish(b"\xff\xfe"), "a packet that is not MQTT (0x30)"),
        (publish(b""), "a packet that is not MQTT (0x30)"),
        (publish(b"a/#"), "a packet that is not MQTT (0x30)"),
        (packet(0x30, b"\0\5a"), "a packet that is not MQTT (0x30)"),
        (packet(0x32, b"\0\1a\0"), "a packet that is not MQTT (0x32)"),
        (packet(0x30, b"\0\1a" + variable(300)), "a packet that is not MQTT (0x30)"),
        (packet(0x40, b"\0\1\0\x80"), "a packet that is not MQTT (0x40)"),
    ],
)
def test_what_is_not_taken_is_named_and_does_not_pass(sent: bytes, words: str) -> None:
    good = publish(b"a", b"before")
    got, fault = asyncio.run(passed(CONNACK + good + sent + publish(b"a", b"after")))
    assert got == CONNACK + good
    assert isinstance(fault, BrokerFaultError)
    assert str(fault) == f"the broker sends {words}"


@pytest.mark.parametrize(
    ("sent", "kind", "words"),
    [
        (b"", NoGreetingError, "closes the connection without a word"),
        (b"\x20\3\0", NoGreetingError, "closes the connection without a word"),
        (b"\x15\3\1\0\2\2\x28", NoGreetingError, "does not speak MQTT"),
        (b"HTTP/1.1 400 Bad Request\r\n", NoGreetingError, "does not speak MQTT"),
        (b"\x20" + variable(250_000_000), BrokerFaultError, "a message of 250 MB; at most 1 kB are taken"),
    ],
)
@pytest.mark.parametrize("protocol", [4, 5])
def test_without_a_greeting_the_library_is_told_that_it_is_refused(
    sent: bytes, kind: type[Exception], words: str, protocol: int
) -> None:
    got, fault = asyncio.run(passed(sent, protocol))
    assert got == {4: b"\x20\x02\0\x03", 5: b"\x20\x03\0\x88\0"}[protocol]  # server unavailable
    assert isinstance(fault, kind)
    assert words in str(fault)


def test_another_program_that_finds_the_address_gets_nothing() -> None:
    """Only this process itself is let in: a child of it is not."""
    look = "import socket, sys; s = socket.socket(socket.AF_UNIX); s.connect('\\0' + sys.argv[1]); print(s.recv(9))"

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(CONNACK)
        await reader.read()
        writer.close()

    async def main() -> bytes:
        async with asyncio.timeout(30.0), await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            async with MqttFilter("127.0.0.1", server.sockets[0].getsockname()[1], None, 5) as broker:
                name = broker.address.removeprefix("\0")
                child = await asyncio.create_subprocess_exec(
                    sys.executable, "-c", look, name, stdout=asyncio.subprocess.PIPE
                )
                seen, _ = await child.communicate()
                reader, writer = await asyncio.open_unix_connection(broker.address)
                writer.write(packet(0x10))
                assert await reader.read(len(CONNACK)) == CONNACK
                writer.close()
            return seen

    assert asyncio.run(main()) == b"b''\n"


# --- the worst of them, on the whole link


def forever(piece: bytes) -> Attack:
    return lambda: itertools.repeat(piece * 100)


def unfinished() -> Iterator[bytes]:
    """Messages of QoS 2 whose second half never comes: each would be kept."""
    for number in itertools.cycle(range(1, 65536)):
        yield publish(REQUEST, bytes(60_000), qos=2, number=number)


def until_words(brokers: HostileBroker, words: str, *, tls: str | None = None) -> tuple[str, int]:
    """Serve a link until it says why there is no connection; that, and the most bytes that were allocated."""

    async def main() -> tuple[str, int]:
        async with brokers.listening():
            settings = Mqtt(host="127.0.0.1", port=brokers.port, tls=tls is not None, ca_file=tls)
            link = MqttLink(
                settings, client_id="me", will=(STATUS, b"off"), subscriptions=(REQUESTS, STATUS), offload=at_once
            )
            link.outbox.keep(STATUS, b"on")
            running = asyncio.create_task(link.run())
            tracemalloc.start()
            try:
                async with asyncio.timeout(60.0):
                    while not re.search(words, link.last_error or ""):
                        await asyncio.sleep(0.01)
                return link.last_error or "", tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()
                running.cancel()
                await asyncio.wait([running])

    return asyncio.run(main())


@pytest.mark.parametrize(
    ("broker", "words"),
    [
        (HostileBroker(lambda: huge(0x30, 250_000_000)), "a message of 250 MB; at most 64 kB are taken$"),
        (HostileBroker(lambda: huge(0x30, 250_000_000), level=4), "a message of 250 MB; at most 64 kB are taken$"),
        (HostileBroker(lambda: huge(0x20, 250_000_000), greets=False), "a message of 250 MB; at most 1 kB are taken$"),
        (HostileBroker(unfinished), r"nobody asked for \(0x34\)$"),
        (HostileBroker(lambda: iter([publish(b"\xff")])), r"not MQTT \(0x30\)$"),
        (HostileBroker(forever(publish(STATUS.encode(), b"x"))), "the broker floods"),
        (HostileBroker(forever(publish(REQUEST, qos=1)), reads=False), "the broker floods"),
        (HostileBroker(forever(packet(0x90, b"\x12\x34\0\1"))), "the broker floods"),
        (HostileBroker(lambda: itertools.repeat(publish(b"a" * 65000))), "the broker floods"),
        (HostileBroker(forever(publish(REQUEST, properties=USER_PROPERTY * 90))), "the broker floods"),
    ],
    ids=[
        "250 MB",
        "250 MB in 3.1.1",
        "greeting",
        "QoS 2",
        "topic",
        "flood",
        "deaf flood",
        "SUBACKs",
        "long topics",
        "properties",
    ],
)
def test_the_worst_broker_is_named_and_costs_next_to_nothing(
    broker: HostileBroker, words: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(mqtt_filter, "FLOOD_S", 1.0)
    said, allocated = until_words(broker, words)
    assert allocated < MOST_ALLOCATED_BYTES
    assert said.startswith(f"127.0.0.1:{broker.port}: the broker ")
    assert "another client" not in said
    assert not [record for record in caplog.records if record.exc_info and record.levelname == "ERROR"]


def test_the_same_over_tls() -> None:
    authority, context = trustme.CA(), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("127.0.0.1").configure_cert(context)
    with authority.cert_pem.tempfile() as ca_file:
        broker = HostileBroker(lambda: huge(0x30, 250_000_000), context=context)
        _, allocated = until_words(broker, "a message of 250 MB", tls=ca_file)
    assert allocated < MOST_ALLOCATED_BYTES


def test_it_comes_back_to_a_broker_that_behaves_again(monkeypatch: pytest.MonkeyPatch) -> None:
    attacks = iter([huge(0x30, 250_000_000), iter([publish(REQUEST, b"{}", properties=USER_PROPERTY * 1000)])])
    heard: list[Incoming] = []

    async def main() -> None:
        came = asyncio.Event()

        def take(message: Incoming) -> None:
            heard.append(message)
            came.set()

        broker = HostileBroker(lambda: next(attacks))
        async with broker.listening():
            link = MqttLink(
                Mqtt(host="127.0.0.1", port=broker.port),
                client_id="me",
                subscriptions=(REQUESTS, STATUS),
                on_message=take,
                offload=at_once,
            )
            running = asyncio.create_task(link.run())
            async with asyncio.timeout(30.0):
                await came.wait()
            assert link.connected
            assert link.connections == broker.connections == 2
            assert "250 MB" in str(link.last_error)
            running.cancel()
            await asyncio.wait([running])

    asyncio.run(main())
    assert heard == [Incoming(REQUEST.decode(), b"{}", retained=False)]


def test_a_stop_in_the_middle_of_an_attempt_leaves_nothing_behind(caplog: pytest.LogCaptureFixture) -> None:
    """Stopped at each step between the first byte and the greeting; warnings of what is left open are errors here."""

    async def main(turns: int) -> None:
        broker = HostileBroker(lambda: iter(()), greets=False)
        async with broker.listening():
            link = MqttLink(Mqtt(host="127.0.0.1", port=broker.port), client_id="me", offload=at_once)
            running = asyncio.create_task(link.run())
            for _ in range(turns):
                await asyncio.sleep(0)
            running.cancel()
            done, _ = await asyncio.wait([running], timeout=10.0)
            assert done
            assert running.cancelled()

    for turns in range(1, 40):
        asyncio.run(main(turns))
    assert not caplog.records
