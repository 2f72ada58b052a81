"""Rotations as tensors: what a GPU computes in few kernels."""

from __future__ import annotations

import pytest
import torch

from dexsim import rotation


@pytest.mark.parametrize("shapes", [((5, 4), (5, 4)), ((4,), (7, 4)), ((3, 1, 4), (1, 6, 4)), ((4,), (4,))])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_few_kernels_say_what_many_say(shapes, dtype):
    """What a GPU gets instead, on the CPU."""
    generator = torch.Generator().manual_seed(0)
    a, b = (rotation.normalize(torch.randn(*s, generator=generator, dtype=dtype)) for s in shapes)
    exact = 4 * torch.finfo(dtype).eps
    torch.testing.assert_close(rotation._multiply_in_few(a, b), rotation.multiply(a, b), rtol=0, atol=exact)
    torch.testing.assert_close(rotation._to_matrix_in_few(a), rotation.to_matrix(a), rtol=0, atol=exact)
    assert rotation._multiply_in_few(a, b).dtype == dtype
