"""The outbox: what comes first, what is dropped, and that nothing makes it grow."""

from __future__ import annotations

from companion.mqtt.client import LONG_BYTES, MAX_ANSWERS, MOST_TRIES, Outbox


async def drain(box: Outbox) -> list[tuple[str, bytes]]:
    """Send everything, as a broker that takes it would see it."""
    got = []
    while len(box):
        parcel = await box.next()
        box.sent(parcel)
        got.append((parcel.topic, parcel.payload))
    return got


async def test_of_what_is_kept_the_latest_value_counts_and_comes_again_after_every_connection() -> None:
    box = Outbox()
    for number in range(1000):
        box.keep("state", b"%d" % number)
    box.keep("status", b"online")
    assert len(box) == 2
    assert await drain(box) == [("state", b"999"), ("status", b"online")]
    box.keep("state", b"999")
    assert len(box) == 0
    box.closed()
    box.opened()
    assert await drain(box) == [("state", b"999"), ("status", b"online")]


async def test_a_value_that_changes_while_it_is_sent_is_sent_again() -> None:
    box = Outbox()
    box.keep("state", b"old")
    parcel = await box.next()
    box.keep("state", b"new")
    box.sent(parcel)
    assert await drain(box) == [("state", b"new")]


async def test_what_the_broker_never_takes_waits_for_another_value() -> None:
    box = Outbox()
    long = bytes(LONG_BYTES + 1)
    box.keep("record", long)
    parcel = await box.next()
    parcel.tries = MOST_TRIES + 1
    box.sent(parcel)
    box.opened()
    box.keep("record", long)
    assert len(box) == 0
    box.keep("record", b"short")
    assert await drain(box) == [("record", b"short")]


async def test_a_flood_of_refusals_pushes_out_refusals_and_no_result() -> None:
    box = Outbox()
    box.answer("response", b"result", droppable=False)
    for number in range(10 * MAX_ANSWERS):
        box.answer("response", b"%d" % number, droppable=True)
    assert len(box) == MAX_ANSWERS
    assert box.dropped == 9 * MAX_ANSWERS + 1
    sent = await drain(box)
    assert sent[0] == ("response", b"result")
    assert sent[-1] == ("response", b"%d" % (10 * MAX_ANSWERS - 1))
    for number in range(2 * MAX_ANSWERS):
        box.answer("response", b"%d" % number, droppable=False)
    assert len(box) == MAX_ANSWERS
    box.answer("response", b"refusal", droppable=True)
    assert ("response", b"refusal") not in await drain(box)


async def test_telemetry_is_only_for_now() -> None:
    box = Outbox()
    box.send_telemetry("attitude", b"before")
    assert len(box) == 0
    box.opened()
    for number in range(100):
        box.send_telemetry("attitude", b"%d" % number)
    parcel = await box.next()
    assert (parcel.topic, parcel.payload, parcel.qos) == ("attitude", b"99", 0)
    box.send_telemetry("attitude", b"lost")
    box.closed()
    assert len(box) == 0
