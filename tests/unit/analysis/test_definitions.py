"""What figures mean."""

from hilctl.analysis.definitions import DEFINITIONS, definitions_of


def test_terms_are_found_in_the_order_of_the_list():
    assert [term for term, _ in definitions_of("loop area", "average cycle")] == [
        "average cycle",
        "loop area",
    ]


def test_every_term_is_defined_once_in_a_sentence():
    assert len({term for term, _ in DEFINITIONS}) == len(DEFINITIONS)
    assert all(meaning.endswith(".") for _, meaning in DEFINITIONS)
