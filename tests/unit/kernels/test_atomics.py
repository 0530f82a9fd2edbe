"""Numbers in shared memory: what a write and a read become, and in which order."""

import mmap
import re

import numba
import numpy as np
import pytest

from hilctl.kernels.atomics import observe, publish

SIGNATURES = {
    publish: "void(int64[::1], int64, int64)",
    observe: "int64(Array(int64, 1, 'C', readonly=True), int64)",
}


@pytest.fixture
def page(tmp_path):
    """Return a shared page, as one process writes it and as another one looks at it."""
    path = tmp_path / "page"
    path.write_bytes(bytes(4096))
    with path.open("r+b") as file:
        written = mmap.mmap(file.fileno(), 4096)
        seen = mmap.mmap(file.fileno(), 4096, prot=mmap.PROT_READ)
    return np.frombuffer(written, np.int64), np.frombuffer(seen, np.int64)


@pytest.mark.parametrize("value", [0, 1, -1, 2**63 - 1, -(2**63)])
def test_what_is_published_is_observed(page, value):
    written, seen = page
    publish(written, 7, value)
    assert observe(seen, 7) == observe(written, 7) == value
    assert np.flatnonzero(written).tolist() == ([7] if value else [])


def test_a_mapping_that_cannot_be_written_is_refused(page):
    with pytest.raises(TypeError):
        publish(page[1], 7, 1)


@pytest.mark.parametrize(("kernel", "operations"), [
    (publish, [("store atomic", "release"), ("fence", "seq_cst")]),
    (observe, [("fence", "acquire"), ("load atomic", "acquire")]),
])  # fmt: skip
def test_what_the_processor_is_asked_for(kernel, operations):
    compiled = numba.njit(SIGNATURES[kernel], error_model="numpy")(kernel.py_func)
    (text,) = compiled.inspect_llvm().values()
    body = re.search(rf"^define [^\n]*{kernel.__name__}.*?^}}", text, re.DOTALL | re.MULTILINE)
    found = re.findall(r"(store atomic|load atomic|fence).* (release|acquire|seq_cst)", body[0])
    assert found == operations
