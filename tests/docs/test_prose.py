"""Sentences of pages and docstrings are easy to read: at most two in a hundred are not."""

import prose
import pytest

MOST = 0.02
"""Largest share of sentences that open with a relative clause, are long or use words to avoid."""


def test_few_sentences_of_pages_and_docstrings_are_hard_to_read():
    found = prose.files()
    pages = sum(len(own) for name, own in found.items() if name.endswith(".md"))
    every = [(name, s) for name, own in found.items() for s in own]
    hard = [f"{name}: {prose.fault(s)}: {s}" for name, s in every if prose.fault(s)]
    assert pages > 1000 and len(every) > 2500
    assert len(hard) <= MOST * len(every), "\n".join(hard)


@pytest.mark.parametrize(
    ("sentence", "why"),
    [
        ("What a study asks of the place is here.", "opens with a relative clause"),
        ("What does TNR mean?", ""),
        ("Whether the tolerance is met.", "opens with a relative clause"),
        ("The figure stands beside it.", "uses 'beside'"),
        ("The promise is held to its word.", "uses 'held to its word'"),
        ("The effects that a scene calls for are simulated.", "uses 'calls for'"),
        (" ".join(["word"] * 35), ""),
        (" ".join(["word"] * 36), "has 36 words"),
    ],
)
def test_a_sentence_at_fault_is_told_from_a_good_one(sentence, why):
    assert prose.fault(sentence) == why
