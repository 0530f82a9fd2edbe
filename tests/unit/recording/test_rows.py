"""Many messages at once are, each, what the protobuf library writes."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis.strategies import floats, integers, lists, sampled_from, tuples

from hilctl.base.samples import RECORDED_FIELDS
from hilctl.recording import schema
from hilctl.recording.rows import SCOPE_T_REL, scope_rows

FIELDS = {each.scope: each.name for each in RECORDED_FIELDS if each.scope} | {SCOPE_T_REL: "t_rel"}
VALUES = floats() | sampled_from([0.0, -0.0, 5e-324])


@given(
    lists(
        tuples(
            integers(0, 2**62), integers(0, 2**32 - 1) | sampled_from([0, 127, 128]),
            lists(VALUES, min_size=len(FIELDS), max_size=len(FIELDS)),
        ),
        max_size=5,
    )
)  # fmt: skip
@example([])
@example([(0, 0, [0.0] * len(FIELDS))])
@example([(0, 0, [1.0] * len(FIELDS)), (127, 1, [0.0] * len(FIELDS)), (128, 0, [-0.0] * 7)])
def test_each_is_what_the_library_writes(rows):
    """Whatever stands beside it: wide numbers, zeros that are left out, numbers that are none."""
    values = np.array([each[2][: len(FIELDS)] for each in rows]).reshape(-1, len(FIELDS))
    found = scope_rows(
        np.array([each[0] for each in rows], dtype=np.int64),
        np.array([each[1] for each in rows], dtype=np.uint32),
        dict(zip(FIELDS, values.T, strict=True)),
    )
    expected = []
    for k, (sample, flags, _) in enumerate(rows):
        message = schema.message("Sample")
        message.sample, message.flags = sample, flags
        for field, value in zip(FIELDS, values[k].tolist(), strict=True):
            setattr(message, FIELDS[field], value)
        expected.append(message.SerializeToString())
    assert list(found.split()) == expected
    assert found.sizes().tolist() == [len(each) for each in expected]
    heads = np.arange(2 * len(rows), dtype=np.uint8).reshape(-1, 2)
    headed = [bytes(head) + each for head, each in zip(heads, expected, strict=True)]
    assert found.behind(heads) == b"".join(headed)


@pytest.mark.parametrize("given_fields", [1, 3])
def test_any_fields_will_do(given_fields):
    """Those of a device that measures less are fewer."""
    fields = sorted(FIELDS)[:given_fields]
    (found,) = scope_rows(
        np.array([300]), np.array([0], np.uint32), {field: np.array([1.5]) for field in fields}
    ).split()
    message = schema.message("Sample")
    message.sample = 300
    for field in fields:
        setattr(message, FIELDS[field], 1.5)
    assert found == message.SerializeToString()
