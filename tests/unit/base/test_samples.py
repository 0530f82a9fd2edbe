"""The table of a sample's columns, and what is made from it."""

from dataclasses import replace

import numpy as np

from hilctl.base.samples import ANSWERS, COLUMNS, RECORDED_FIELDS, BlockBatch, BlockHeader, Samples

BLOCK = 5


def batch(blocks: int) -> BlockBatch:
    """Return consecutive blocks of random numbers."""
    made = BlockBatch.empty(blocks, BLOCK, 1, aux=2)
    made.aux[:] = np.arange(2 * blocks).reshape(blocks, 2)
    rng = np.random.default_rng(1)
    made.heads[:, BlockHeader.FIRST_SAMPLE] = 100 + BLOCK * np.arange(blocks)
    made.columns[:] = rng.normal(size=made.columns.shape)
    made.flags[:] = rng.integers(0, 1000, made.flags.shape)
    return made


def same(found: Samples, expected: Samples) -> bool:
    """Return whether every array is the same."""
    return all(
        np.array_equal(getattr(found, name), getattr(expected, name))
        for name in ("index", "flags", "aux", *COLUMNS)
    )


def test_fields_and_numbers_of_columns_are_unique() -> None:
    assert len({each.name for each in RECORDED_FIELDS}) == len(RECORDED_FIELDS)
    for message in ("block", "before", "scope"):
        numbers = [number for each in RECORDED_FIELDS if (number := getattr(each, message))]
        assert len(set(numbers)) == len(numbers)


def test_rows_of_a_block_are_the_columns_in_order() -> None:
    made = batch(3)
    samples = made.samples(slice(1, None))
    assert samples.index.tolist() == list(range(105, 115))
    for row, name in enumerate(COLUMNS):
        assert getattr(samples, name).tolist() == made.columns[1:, row].ravel().tolist()
    assert samples.flags.tolist() == made.flags[1:].ravel().tolist()
    assert samples.aux.tolist() == [[2.0, 3.0]] * BLOCK + [[4.0, 5.0]] * BLOCK
    answers = ["displacement_um", "measured", "reading_age_s", "reading_um"]
    assert [list(COLUMNS)[row] for row in ANSWERS] == answers


def test_rows_are_chosen_of_every_column() -> None:
    samples = batch(3).samples()
    odd = samples.index % 2 == 1
    for name, values in samples.rows(odd).columns().items():
        assert values.tolist() == samples.columns()[name][odd].tolist()
    assert same(samples.part(103, 109), samples.rows(slice(3, 9)))
    assert same(samples.rows(slice(0, 4)).followed_by(samples.rows(slice(4, None))), samples)
    unmeasured = replace(samples, measured=np.empty(0)).rows(odd)
    assert (unmeasured.measured.size, unmeasured.command.size) == (0, 7)
