"""Chooses the library with which PyTorch multiplies float32 matrices on the CPU, and times bfloat16.

PyTorch has two such libraries. Its default, Intel's MKL, does not use the AVX-512 units of processors that
are not Intel's. The other one, oneDNN, uses them, but PyTorch calls it only where bfloat16 factors are
allowed. On processors with units for bfloat16 matrices (AMX), oneDNN then rounds the factors. On all others
it multiplies in float32, up to twice as fast as MKL.
"""

import contextlib
import time
import warnings
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def products() -> Iterator[None]:
    """Inside this context, the CPU multiplies float32 matrices with the fastest library that is exact.

    Exact means that all 24 bits of the factors count. Only the order of the sums may change. Other devices
    are not affected.
    """
    matmul = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = matmul.fp32_precision
    try:
        matmul.fp32_precision = "bf16"
        if not _exact():
            matmul.fp32_precision = before
        yield
    finally:
        matmul.fp32_precision = before


def _exact() -> bool:
    """Returns whether products, as they are set now, are as exact as float32.

    It multiplies factors that bfloat16 cannot represent.
    """
    generator = torch.Generator().manual_seed(0)
    for rows, inner, columns in ((256, 128, 128), (512, 40, 256), (1024, 512, 512)):  # the networks' sizes
        a = torch.rand(rows, inner, generator=generator) + 1
        b = torch.rand(inner, columns, generator=generator) + 1
        error = (a @ b).double() / (a.double() @ b.double()) - 1
        if error.abs().max() > 1e-5:  # with bfloat16 it is about 1e-3
            return False
    return True


def bfloat16_time(rounds: int = 5) -> float:
    """Returns the CPU's time for a matrix product in bfloat16, as a multiple of its time in float32.

    It is about one half with AVX512_BF16. Without such units the product is emulated and takes 3 to 40 times
    as long as in float32. The time is the best of `rounds` rounds.
    """
    factor = torch.ones(512, 512)
    best = dict.fromkeys((torch.float32, torch.bfloat16), float("inf"))
    with products():
        for _ in range(rounds + 1):  # the formats take turns; the first round starts the library
            for dtype in best:
                a = factor.to(dtype)
                start = time.perf_counter()
                a @ a
                best[dtype] = min(best[dtype], time.perf_counter() - start)
    return best[torch.bfloat16] / best[torch.float32]


def warn_where_bfloat16_is_slow() -> None:
    """Warns if a product in bfloat16 takes this CPU more than 1.2 times as long as one in float32."""
    multiple = bfloat16_time()
    if multiple > 1.2:
        warnings.warn(
            f"this CPU emulates bfloat16 and takes {multiple:.1f} times as long for a product as in float32: "
            "leave out precision=bfloat16",
            stacklevel=3,
        )
