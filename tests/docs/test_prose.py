"""Sentences of pages and docstrings are easy to read: at most two in a hundred a file are not."""

import prose
import pytest

MOST = 0.02
"""Largest share of a file's sentences that are long, open with a relative clause or use AVOID."""


def test_few_sentences_of_any_page_or_module_are_hard_to_read():
    found = prose.sentences_by_file()
    pages = sum(len(own) for name, own in found.items() if name.endswith(".md"))
    assert pages > 1500 and sum(map(len, found.values())) > 5000
    hard = {name: [s for s in own if prose.sentence_fault(s)] for name, own in found.items()}
    too_many = {name: each for name, each in hard.items() if len(each) > MOST * len(found[name])}
    assert not too_many, "\n".join(
        f"{name}: {prose.sentence_fault(s)}: {s}" for name, each in too_many.items() for s in each
    )


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
    assert prose.sentence_fault(sentence) == why
