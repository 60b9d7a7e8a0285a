"""Layers written out as products and sums, exact or rounded to bfloat16: what networks are compared with."""

import numpy as np
import torch


def relu_mlp(x, weights, biases):
    """Layer by layer, with nn.Linear's own weights (out, in)."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = (x @ weight.T + bias).clamp(min=0)
    return x @ weights[-1].T + biases[-1]


def to_bfloat16(x):
    """To the nearest number with 8 bits, of two equally near ones the even: by the bits of a float32."""
    bits = x.numpy().astype(np.float32).view(np.uint32).astype(np.uint64)
    bits = (bits + 0x7FFF + (bits >> 16 & 1)) & 0xFFFF0000
    return torch.from_numpy(bits.astype(np.uint32).view(np.float32).astype(float))


def rounded_mlp(x, weights, biases):
    """`relu_mlp` where inputs, products and outputs of hidden layers are rounded."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = to_bfloat16(to_bfloat16(x) @ to_bfloat16(weight).T + to_bfloat16(bias)).clamp(min=0)
    return x @ weights[-1].T + biases[-1]
