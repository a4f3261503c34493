"""A line read at another setting than it was sent: facts that are known of every UART."""

from __future__ import annotations

import random

import pytest

from sim.uart import Setting, heard, parity_bit, receive, transmit

SLOW = Setting(4800)
USUAL = Setting(9600)
FAST = Setting(19200)
EVEN = Setting(9600, "even")
ODD = Setting(9600, "odd")


@pytest.mark.parametrize("setting", [USUAL, EVEN, ODD, Setting(115200, "odd")])
@pytest.mark.parametrize("gap", [0, 1, 7])
def test_every_byte_arrives_where_both_ends_agree(setting: Setting, gap: int) -> None:
    data = bytes(range(256))
    frames = list(receive(transmit(data, setting, gap), setting))
    assert bytes(frame.byte for frame in frames) == data
    assert not any(frame.framing_error or frame.parity_error for frame in frames)


def test_0x55_at_half_the_speed() -> None:
    # U on the wire is 0 1 0 1 0 1 0 1 0 1: a square wave. Read twice as fast it is 0 0 1 1 0 0 1 1 0 0: a start bit,
    # the data 0 1 1 0 0 1 1 0, and a low in the place of the stop bit.
    first = next(receive(transmit(b"U", SLOW), USUAL))
    assert first.byte == 0x66
    assert first.framing_error


def test_0xf0_at_double_speed_and_half() -> None:
    # Sent at 9600: low start, four low, four high, stop. At 19200: 10 half bits low make a start and 8 zeros and a low
    # stop bit: a break, NUL with a framing error.
    first = next(receive(transmit(b"\xf0", USUAL), FAST))
    assert (first.byte, first.framing_error) == (0, True)
    # Read at 4800: start over two low bits, then low (bits 2 and 3), then high for ever.
    first = next(receive(transmit(b"\xf0", USUAL), SLOW))
    assert (first.byte, first.framing_error) == (0b11111110 & 0xFE, False)


def test_nul_is_a_break_at_every_higher_speed() -> None:
    for baud in (19200, 38400, 115200):
        first = next(receive(transmit(b"\0", USUAL), Setting(baud)))
        assert (first.byte, first.framing_error) == (0, True)


def test_the_parity_bit() -> None:
    assert parity_bit(0b0000_0111, "even") == 1
    assert parity_bit(0b0000_0011, "even") == 0
    assert parity_bit(0b0000_0011, "odd") == 1


def test_8e1_read_as_8n1_spoils_exactly_the_bytes_with_an_even_number_of_ones_where_there_are_pauses() -> None:
    # The parity bit stands where the stop bit is looked for: 1 passes for it, 0 is an error. The byte is right.
    for byte in range(256):
        first = next(receive(transmit(bytes([byte]), EVEN), USUAL))
        assert first.byte == byte
        assert first.framing_error == (byte.bit_count() % 2 == 0)


def test_8n1_read_as_8e1_fails_the_parity_of_bytes_with_an_even_number_of_ones() -> None:
    # The stop bit, 1, stands where the parity bit is looked for; the idle line is the stop bit.
    for byte in range(256):
        first = next(receive(transmit(bytes([byte]), USUAL), EVEN))
        assert first.byte == byte
        assert first.parity_error == (byte.bit_count() % 2 == 0)
        assert not first.framing_error
        assert heard(bytes([byte]), USUAL, EVEN) == (b"\0" if first.parity_error else bytes([byte]))


def test_8e1_read_as_8n1_spoils_the_byte_behind_each_one_with_an_even_number_of_ones() -> None:
    # "with 8E1 opened as 8N1 every other byte looks corrupted": A has two ones, so its parity bit is a low stop bit,
    # which is taken for a start bit; what follows it are a stop bit, a start bit and the first bits of the next byte.
    frames = list(receive(transmit(b"AAAA", EVEN), USUAL))
    assert [frame.byte for frame in frames[:2]] == [ord("A"), (ord("A") << 2 | 0b01) & 0xFF]
    # C has three: nothing is wrong with it.
    assert heard(b"CCCC", EVEN, USUAL) == b"CCCC"


def test_without_pauses_8n1_read_as_8e1_takes_the_next_start_bit_for_the_stop_bit() -> None:
    frames = list(receive(transmit(b"AA", USUAL), EVEN))
    assert frames[0].framing_error


def test_at_the_wrong_speed_next_to_nothing_of_a_text_is_left() -> None:
    text = b"X=+00.430\r\nY=-00.084\r\n" * 20
    for baud in (1200, 2400, 4800, 19200, 38400, 57600, 115200):
        assert b"X=+00" not in heard(text, USUAL, Setting(baud))
    # A few per cent off is what every crystal may be.
    assert heard(text, USUAL, Setting(9700)) == text
    assert heard(text, USUAL, Setting(8800)) != text


def test_an_edge_is_followed_by_a_frame_whatever_is_on_the_line() -> None:
    chance = random.Random(4)
    for _ in range(50):
        data = chance.randbytes(60)
        read = Setting(chance.choice([300, 4800, 9600, 14400, 230400]), chance.choice(["none", "even", "odd"]))
        assert len(heard(data, USUAL, read, chance.randrange(4))) < 60 * 30
