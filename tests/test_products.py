"""Which library multiplies: the setting comes and goes, and products stay as exact as it says."""

import pytest
import torch
from torch.backends.mkldnn import matmul

from tutorial_lib import products as module
from tutorial_lib.products import products

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


@pytest.mark.parametrize("kind", KINDS)
def test_bfloat16_products_are_exact_to_8_bits(kind):
    with products("bfloat16"):
        found, exact = KINDS[kind](*factors(512, 256, 256))
    torch.testing.assert_close(found.double(), exact, rtol=2**-8, atol=0)


def test_where_products_would_be_rounded_float32_leaves_the_setting_alone(monkeypatch):
    before = matmul.fp32_precision
    monkeypatch.setattr(module, "_exact", lambda: False)
    with products("float32"):
        assert matmul.fp32_precision == before
    with products("bfloat16"):
        assert matmul.fp32_precision == "bf16"
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
