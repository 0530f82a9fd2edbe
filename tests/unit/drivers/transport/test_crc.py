"""CRCs against their parameters and catalogued check values."""

import random

import numpy as np
import pytest

from hilctl_drivers.transport.crc import CRCS, MODBUS_WORDS, crc16_modbus

# Width, polynomial, initial value, reflection in and out, final XOR, and CRC of "123456789", from
# the "Catalogue of parametrised CRC algorithms".
CATALOGUE = {
    "crc16_modbus": (16, 0x8005, 0xFFFF, True, True, 0x0000, 0x4B37),
    "crc16_ccitt_false": (16, 0x1021, 0xFFFF, False, False, 0x0000, 0x29B1),
    "crc16_xmodem": (16, 0x1021, 0x0000, False, False, 0x0000, 0x31C3),
    "crc32": (32, 0x04C11DB7, 0xFFFFFFFF, True, True, 0xFFFFFFFF, 0xCBF43926),
}


def reflected(value, width):
    """Return ``value`` with its bits in reverse."""
    return int(f"{value:0{width}b}"[::-1], 2)


def by_definition(name, data):
    """Divide bit by bit, straight from the parameters."""
    width, poly, register, refin, refout, xorout, _ = CATALOGUE[name]
    for byte in data:
        register ^= (reflected(byte, 8) if refin else byte) << (width - 8)
        for _ in range(8):
            register <<= 1
            if register >> width:
                register ^= 1 << width | poly
    return (reflected(register, width) if refout else register) ^ xorout


@pytest.mark.parametrize("name", CATALOGUE)
def test_crc_has_its_catalogued_check_value(name):
    """Width and the CRC of "123456789" are those of the catalogue."""
    crc = CRCS[name]
    assert (crc.width, crc.compute(b"123456789")) == (CATALOGUE[name][0], CATALOGUE[name][-1])


@pytest.mark.parametrize("name", CATALOGUE)
def test_fast_function_is_the_one_the_parameters_say(name):
    crc = CRCS[name]
    rng = random.Random(1)
    for size in range(70):
        data = rng.randbytes(size)
        want = by_definition(name, data)
        assert crc.compute(data) == want
        assert crc.compute(bytearray(data)) == crc.compute(memoryview(data)) == want
        assert crc.of(data) == want.to_bytes(crc.width // 8, "little")


def test_every_named_crc_is_checked_here():
    assert set(CRCS) == {*CATALOGUE, "none"}
    none = CRCS["none"]
    assert (none.size, none.of(b"123456789")) == (0, b"")


def syndromes(name, size):
    """Return what each flipped bit of ``size`` bytes and their CRC does to the check, in the order
    in which a serial port sends bits: uint32[8 * (size + crc.size)]."""
    crc = CRCS[name]
    clean = crc.compute(bytes(size))
    flips = [(1 << bit).to_bytes(size, "little") for bit in range(8 * size)]
    own = [1 << bit for bit in range(crc.width)]
    return np.array([crc.compute(flip) ^ clean for flip in flips] + own, dtype=np.uint32)


@pytest.mark.parametrize("name", CATALOGUE)
def test_up_to_three_flipped_bits_are_always_seen(name):
    """In a message of 64 bytes no three flips, its CRC's own bits included, cancel out."""
    flips = syndromes(name, 64)
    assert np.all(flips)
    first, second = np.triu_indices(len(flips), 1)
    pairs = flips[first] ^ flips[second]
    assert np.all(pairs)
    assert not np.isin(pairs, flips).any()


@pytest.mark.parametrize(
    ("name", "bits"),
    [("crc16_modbus", 16), ("crc16_ccitt_false", 14), ("crc16_xmodem", 14), ("crc32", 18)],
)
def test_bursts_up_to_this_many_bits_are_always_seen(name, bits):
    """Wherever the burst begins, across the seam of message and CRC too.

    A CRC that takes its bits in the order of the wire is sure of bursts as long as itself. The
    CCITT ones take each byte from the other end and are sent low byte first, and lose two bits.
    (crc32 is sure of 32; more than 18 would take too long to count here.)
    """
    flips = syndromes(name, 12)
    for start in range(len(flips)):
        effects = flips[start : start + 1]
        for flip in flips[start + 1 : start + bits]:
            effects = np.concatenate([effects, effects ^ flip])
        assert np.all(effects)


def test_modbus_crc_two_bytes_at_a_time_is_the_same():
    source = random.Random(5)
    for _ in range(500):
        data = source.randbytes(2 * source.randrange(20))
        crc = 0xFFFF
        for word in np.frombuffer(data, dtype="<u2").tolist():
            crc = MODBUS_WORDS[crc ^ word]
        assert crc == crc16_modbus(data)
