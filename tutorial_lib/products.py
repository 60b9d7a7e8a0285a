"""Which of PyTorch's two libraries multiplies float32 matrices on the CPU, and how exactly.

Its default, Intel's MKL, leaves the AVX-512 units of other makers' processors idle. The other one, oneDNN,
uses what there is, but is only asked where bfloat16 factors are allowed. On processors with units for these
(AMX) it then rounds; on all others it multiplies in float32 as before, up to twice as fast.
"""

import contextlib
from typing import Literal

import torch

Precision = Literal["float32", "bfloat16"]


@contextlib.contextmanager
def products(precision: Precision = "float32"):
    """Inside, the CPU multiplies with the quickest library of this precision; other devices are left alone.

    float32: every product keeps its 24 bits; only the order of sums may change. bfloat16: factors may be
    rounded to 8 bits, which is quicker on a CPU with AMX, and the same as float32 on all others.
    """
    matmul = torch.backends.mkldnn.matmul
    before = matmul.fp32_precision
    try:
        matmul.fp32_precision = "bf16"
        if precision == "float32" and not _exact():
            matmul.fp32_precision = before
        yield
    finally:
        matmul.fp32_precision = before


def _exact() -> bool:
    """Are products, set as they are, as exact as float32? Factors that bfloat16 cannot hold tell."""
    generator = torch.Generator().manual_seed(0)
    for rows, inner, columns in ((256, 128, 128), (512, 40, 256), (1024, 512, 512)):  # as the networks'
        a = torch.rand(rows, inner, generator=generator) + 1
        b = torch.rand(inner, columns, generator=generator) + 1
        error = (a @ b).double() / (a.double() @ b.double()) - 1
        if error.abs().max() > 1e-5:  # bfloat16: about 1e-3
            return False
    return True
