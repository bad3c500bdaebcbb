import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.model.sampling import philox
from sweep.model.sampling.philox import (
    four_words,
    normal_pair,
    point_keys,
    to_normals_by_row,
    uniform,
    uniforms,
)

without_deadline = settings(deadline=None)  # the first call may compile
words = st.integers(0, 2**64 - 1).map(np.uint64)
numbers = st.integers(0, 2**40)
KEY = np.uint64(0x0123456789ABCDEF), np.uint64(0xFEDCBA9876543210)


def numpys_block(key, counter):
    """Four raw outputs of numpy's generator at a counter, which it raises by 1 beforehand."""
    before = (sum(int(word) << (64 * i) for i, word in enumerate(counter)) - 1) % 2**256
    generator = np.random.Philox(key=int(key[0]) + (int(key[1]) << 64), counter=before)
    return tuple(int(word) for word in generator.random_raw(4))


def centre(word):
    """Centre of the cell of (0, 1) that a word's upper 52 bits name."""
    return (word // 2**12 * 2 + 1) / 2**53  # whole numbers: the division is exact


@given(st.tuples(words, words), words, words, words)
@without_deadline
def test_every_block_equals_numpys_bit_for_bit(key, block, draw, stream):
    words = numpys_block(key, (block, 0, draw, stream))
    assert four_words(*key, draw, stream, block) == words


def test_known_answers_of_the_authors_library_are_met():
    # Random123's kat_vectors for philox4x64-10: all bits zero.
    zero = np.uint64(0)
    words = 0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B
    assert four_words(zero, zero, 0, 0, 0) == words


@given(st.tuples(words, words), numbers, st.integers(0, 100), numbers)
@without_deadline
def test_a_uniform_is_addressed_by_block_draw_and_stream(key, draw, stream, index):
    raw = numpys_block(key, (index // 4, 0, draw, stream))[index % 4]
    assert uniform(*key, draw, stream, index) == centre(raw)


@given(st.tuples(words, words), numbers, st.integers(1, 100), st.integers(0, 9))
@without_deadline
def test_a_record_of_normal_numbers_is_that_of_pairs_one_by_one(key, draw, stream, number):
    pairs = [normal_pair(*key, draw, stream, i) for i in range(number)]
    drawn = uniforms(np.array([key, key]), np.array([7, draw]), stream, 2 * number)
    np.testing.assert_allclose(to_normals_by_row(drawn)[1], np.ravel(pairs), rtol=1e-14, atol=1e-15)


@given(numbers, numbers)
@without_deadline
def test_a_noise_pair_comes_from_its_own_two_uniforms(draw, index):
    x, y = normal_pair(*KEY, draw, 7, index)
    u, v = uniform(*KEY, draw, 7, 2 * index), uniform(*KEY, draw, 7, 2 * index + 1)
    assert math.exp(-(x * x + y * y) / 2) == pytest.approx(u, rel=1e-13)
    assert math.atan2(y, x) / (2 * math.pi) % 1.0 == pytest.approx(v, abs=1e-14)


def test_streams_have_numbers_of_their_own():
    named = [np.ravel(value) for name, value in vars(philox).items() if name.startswith("STREAM_")]
    streams = np.concatenate(named).tolist()
    assert len(streams) == len(set(streams)) > 0
    assert all(0 <= stream < 2**64 for stream in streams)


def test_keys_are_those_of_a_checksum_made_outside_python():
    # b2sum -l 128 of: length and text of domain and seed (lengths 8 bytes), three doubles.
    expected = "4b55ef377d438e2710c5661d8d02a1b2"
    keys = point_keys([[1.5, -0.0, -2e9]], domain="test", seed=42)
    assert keys.dtype == np.uint64
    assert keys.astype("<u8").tobytes().hex() == expected


def test_a_points_key_depends_on_its_row_and_not_on_its_place():
    rows = np.random.default_rng(2).normal(size=(50, 6))
    keys = point_keys(rows, domain="grid", seed=3)
    order = np.random.default_rng(3).permutation(50)
    assert keys.shape == (50, 2)
    assert np.array_equal(point_keys(rows[order], domain="grid", seed=3), keys[order])
    assert np.array_equal(point_keys(rows[7:9], domain="grid", seed=3), keys[7:9])
    assert np.array_equal(point_keys(np.asfortranarray(rows), domain="grid", seed=3), keys)


def test_any_change_of_row_domain_or_seed_changes_the_key():
    row = [1.0, 2.0, 0.0]
    variants = [
        ([1.0, 2.0, 0.0], "a", 1),
        ([2.0, 1.0, 0.0], "a", 1),
        ([1.0, 2.0, 5e-324], "a", 1),
        ([1.0, np.nextafter(2.0, 3.0), 0.0], "a", 1),
        ([1.0, 2.0], "a", 1),
        (row, "b", 1),
        (row, "a1", 1),
        (row, "a", 11),
        (row, "a", 2**70),
    ]
    keys = {tuple(point_keys([r], domain=d, seed=s)[0]) for r, d, s in variants}
    assert len(keys) == len(variants)


def test_negative_zero_is_the_point_zero():
    keys = point_keys([[0.0, 1.0], [-0.0, 1.0]], domain="a", seed=0)
    assert np.array_equal(keys[0], keys[1])


def test_no_points_have_no_keys():
    assert point_keys(np.empty((0, 3)), domain="a", seed=0).shape == (0, 2)


def test_rows_that_name_no_point_are_refused():
    with pytest.raises(ValueError, match="nan"):
        point_keys([[1.0, math.nan]], domain="a", seed=0)
    with pytest.raises(ValueError, match=r"shape \(n, m\)"):
        point_keys([1.0, 2.0], domain="a", seed=0)
    with pytest.raises(ValueError, match="seed"):
        point_keys([[1.0]], domain="a", seed=-1)
