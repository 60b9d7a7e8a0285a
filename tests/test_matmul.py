"""Which library multiplies: the setting comes and goes, and products stay exact."""

import warnings
from types import SimpleNamespace

import pytest
import torch
from torch.backends.mkldnn import matmul

from tutorial_lib import matmul as module
from tutorial_lib.matmul import bfloat16_time, products, warn_where_bfloat16_is_slow

KINDS = {  # every kind of product in an update, forward and backward, from factors in [1, 2)
    "mm": lambda a, b: (a[0] @ b[0], a[0].double() @ b[0].double()),
    "transposed": lambda a, b: (a[0].mT @ a[1], a[0].double().mT @ a[1].double()),
    "addmm": lambda a, b: (torch.addmm(b[0, 0], a[0], b[0]), b[0, 0] + a[0].double() @ b[0].double()),
    "bmm": lambda a, b: (a @ b, a.double() @ b.double()),
    "baddbmm": lambda a, b: (torch.baddbmm(b[:, :1], a, b), b[:, :1] + a.double() @ b.double()),
}


def factors(rows, inner, columns):
    generator = torch.Generator().manual_seed(1)
    return (torch.rand(2, *shape, generator=generator) + 1 for shape in ((rows, inner), (inner, columns)))


@pytest.mark.parametrize("shape", [(512, 256, 256), (512, 43, 256), (1024, 512, 512), (256, 128, 1)])
@pytest.mark.parametrize("kind", KINDS)
def test_float32_products_are_exact_to_float32(kind, shape):
    with products():
        found, exact = KINDS[kind](*factors(*shape))
    torch.testing.assert_close(found.double(), exact, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("exact", "setting"), [(True, "bf16"), (False, None)])
def test_where_products_would_be_rounded_the_setting_is_left_alone(exact, setting, monkeypatch):
    before = matmul.fp32_precision
    monkeypatch.setattr(module, "_exact", lambda: exact)
    with products():
        assert matmul.fp32_precision == (setting or before)
    assert matmul.fp32_precision == before


def test_rounding_is_noticed(monkeypatch):
    assert module._exact()  # MKL's
    multiply = torch.Tensor.matmul

    def rounded(a, b):
        if a.dtype == torch.float32:
            a, b = (x.bfloat16().float() for x in (a, b))
        return multiply(a, b)

    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    assert not module._exact()


def test_the_setting_is_put_back_after_an_error():
    before = matmul.fp32_precision
    with pytest.raises(ZeroDivisionError), products():
        raise ZeroDivisionError
    assert matmul.fp32_precision == before


# --- bfloat16 ---


def test_the_time_of_bfloat16_is_a_multiple_of_float32s(monkeypatch):
    """A clock that only products move: by 3 seconds in bfloat16, by 2 in float32, at first by much more."""
    seconds, calls = [0.0], []

    def multiply(a, b):
        calls.append(a.dtype)
        seconds[0] += (3 if a.dtype == torch.bfloat16 else 2) + (50 if len(calls) < 3 else 0)
        return a

    monkeypatch.setattr(module, "_exact", lambda: True)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: seconds[0]))
    monkeypatch.setattr(torch.Tensor, "__matmul__", multiply)
    assert bfloat16_time(rounds=2) == 1.5
    assert calls == 3 * [torch.float32, torch.bfloat16]


def test_a_cpu_that_emulates_bfloat16_is_warned_of(monkeypatch):
    monkeypatch.setattr(module, "bfloat16_time", lambda: 7.04)
    with pytest.warns(UserWarning, match="7.0 times as long .*leave out precision=bfloat16"):
        warn_where_bfloat16_is_slow()
    monkeypatch.setattr(module, "bfloat16_time", lambda: 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_where_bfloat16_is_slow()
