"""Which of PyTorch's two libraries multiplies float32 matrices on the CPU, and whether bfloat16 is quicker.

Its default, Intel's MKL, leaves the AVX-512 units of other makers' processors idle. The other one, oneDNN,
uses what there is, but is only asked where bfloat16 factors are allowed. On processors with units for these
(AMX) it then rounds; on all others it multiplies in float32 as before, up to twice as fast.
"""

import contextlib
import time
import warnings

import torch


@contextlib.contextmanager
def products():
    """Inside, the CPU multiplies float32 matrices with the quickest library that keeps all 24 bits.

    Only the order of sums may change; other devices are left alone.
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
    """Are products, set as they are, as exact as float32? Factors that bfloat16 cannot hold tell."""
    generator = torch.Generator().manual_seed(0)
    for rows, inner, columns in ((256, 128, 128), (512, 40, 256), (1024, 512, 512)):  # as the networks'
        a = torch.rand(rows, inner, generator=generator) + 1
        b = torch.rand(inner, columns, generator=generator) + 1
        error = (a @ b).double() / (a.double() @ b.double()) - 1
        if error.abs().max() > 1e-5:  # bfloat16: about 1e-3
            return False
    return True


def bfloat16_time(rounds: int = 5) -> float:
    """What a product in bfloat16 takes on the CPU, as a multiple of the same one's time in float32.

    About a half with AVX512_BF16. Without such units it is emulated: three to forty times as long.
    """
    factor = torch.ones(512, 512)
    best = dict.fromkeys((torch.float32, torch.bfloat16), float("inf"))
    with products():
        for _ in range(rounds + 1):  # in turns; the first wakes the library
            for dtype in best:
                a = factor.to(dtype)
                start = time.perf_counter()
                a @ a
                best[dtype] = min(best[dtype], time.perf_counter() - start)
    return best[torch.bfloat16] / best[torch.float32]


def warn_where_bfloat16_is_slow() -> None:
    """Say what it costs on a CPU that emulates it."""
    multiple = bfloat16_time()
    if multiple > 1.2:
        warnings.warn(
            f"this CPU takes {multiple:.1f} times as long for a product in bfloat16 as in float32, which it "
            "emulates: leave out precision=bfloat16",
            stacklevel=3,
        )
