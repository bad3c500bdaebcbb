"""The count of compiled functions that `make size` prints."""

import ast

import code_size


def test_functions_count_as_compiled_by_whatever_name_a_module_knows_numba():
    module = """
from functools import cache
import numba as nb
from numba import njit as fast, prange
_inlined = partial(fast, inline="always")
@fast
def one(): ...
@_inlined(cache=True)
def two(): ...
@nb.njit
def three(): ...
@cache
def none(): ...
"""
    assert code_size.count_compiled_in_module(ast.parse(module)) == 3
