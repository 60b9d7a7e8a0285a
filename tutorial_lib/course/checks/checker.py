"""This module checks the claims of the notebooks and holds the code that all exercise checkers use."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from tutorial_lib.course.tabular import CMDP
from tutorial_lib.tasks import Task


def check(name: str, value, expected, tolerance: float = 0.0) -> None:
    """Checks that `value` differs from `expected` by at most `tolerance`, and prints both.

    Every element of an array must satisfy this. Two arrays must have the same shape. A scalar `expected` is
    compared with every element of `value`. With a tolerance, the value that was found is printed with one
    digit more than the tolerance has. Raises AssertionError.
    """
    value, expected = np.asarray(value, float), np.asarray(expected, float)
    if value.shape != expected.shape and expected.ndim:
        raise AssertionError(f"FAILED  {name}: shape {value.shape}, expected {expected.shape}")
    close = np.abs(value - expected) <= tolerance  # a comparison with NaN is False
    if not np.all(close):
        raise AssertionError(f"FAILED  {name} = {text(value)}, expected {text(expected)} +/- {tolerance:g}")
    if not tolerance:
        print(f"OK  {name} = {text(expected)}")
        return
    print(f"OK  {name}: found {_rounded(value, tolerance)}, expected {text(expected)} +/- {tolerance:g}")


def check_at_most(name: str, value: float, bound: float) -> None:
    """Checks that `value` is at most `bound`, and prints both. Raises AssertionError."""
    if not value <= bound:
        raise AssertionError(f"FAILED  {name} = {text(value)}, expected at most {text(bound)}")
    print(f"OK  {name}: found {value:.2g}, expected at most {text(bound)}")


def check_that(claim: str, holds) -> None:
    """Checks that `holds` is true, and in an array that every element is true. Raises AssertionError."""
    holds = np.asarray(holds)
    if not holds.all():
        where = f" in {np.sum(~holds)} of {holds.size} cases" if holds.ndim else ""
        raise AssertionError(f"FAILED  {claim}: it does not{where}")
    print(f"OK  {claim}")


def text(value) -> str:
    """Returns `value` as the text that a message shows. Numbers have five significant digits."""
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    if isinstance(value, Task):
        return value.name
    if isinstance(value, CMDP):
        return f"a CMDP of {len(value.initial)} states"
    if np.ndim(value):
        return "[" + ", ".join(text(element) for element in value) + "]"
    is_number = isinstance(value, int | float | np.number | np.ndarray) and not isinstance(value, bool)
    return f"{value:.5g}" if is_number else str(value)


def _rounded(value: np.ndarray, tolerance: float) -> str:
    """Returns the numbers of `value` with one digit more than `tolerance` has."""
    if value.ndim:
        return "[" + ", ".join(_rounded(element, tolerance) for element in value) + "]"
    decimals = max(0, 1 - math.floor(math.log10(tolerance)))
    return f"{value:.{decimals}f}"


def given(
    answer: Callable, arguments: Sequence, call: str = "", read: Callable[[Any], Any] = lambda got: got
) -> Any:
    """Returns what the reader's function gives for `arguments`, as `read` understands it.

    Where it gives nothing, or where it or `read` raises an error, this is printed and None is returned.
    `call` shows the call in the message. By default it is the name of the function.
    """
    name = name_of(answer)
    try:
        got = answer(*arguments)
        if got is not None:
            return read(got)
        print(f"NOT YET  {name} returns nothing: write it in place of the `...`")
    except Exception as error:  # the reader's code can raise any error
        print(f"NOT YET  {call or name} raised {type(error).__name__}: {error}")
    return None


def name_of(answer: Callable) -> str:
    """Returns the name of the reader's function."""
    return getattr(answer, "__name__", "the answer")


def try_answer(answer: Callable, cases: Sequence, mistakes: Sequence = ()) -> None:
    """Prints the first mistake of `answer`, or OK.

    Each case is a tuple of the arguments, the expected value and a hint. The hint is printed with a wrong
    value. Each of `mistakes` is a function of the same arguments and a hint, which is printed in the place of
    the case's own where that function gives the same value. NaN is right where it is expected.
    """
    name = name_of(answer)
    for arguments, expected, hint in cases:
        call = f"{name}({', '.join(text(argument) for argument in arguments)})"
        got = given(answer, arguments, call)
        if got is None:
            return
        if not _is_close(got, expected):
            known = [words for wrong, words in mistakes if _is_close(got, wrong(*arguments), 1e-4)]
            print(f"NOT YET  {call} = {text(got)}, expected {text(expected)}: {(known or [hint])[0]}")
            return
    print(f"OK  {name} is right in {len(cases)} cases")


def _is_close(got, expected, tolerance: float = 1e-6) -> bool:
    """Returns whether `got` has the shape of `expected` and equal values, up to rounding."""
    try:
        close = np.allclose(got, expected, atol=tolerance, equal_nan=True)
        return bool(np.shape(got) == np.shape(expected) and close)
    except (TypeError, ValueError):  # `got` is not a number
        return False
