"""Structs of Warp kernels filled from torch."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp


def filled(kind: Any, **values: Any) -> Any:
    """Return a new struct of this kind, every field by name. Raises TypeError for other names. Tensors are shared, not
    copied, except int64 where the kernel wants int32."""
    made = kind()
    if set(values) != set(kind.vars):
        raise TypeError(f"{kind.key}: {sorted(set(values) ^ set(kind.vars))} missing or unknown")
    for name, value in values.items():
        if isinstance(value, torch.Tensor):
            dtype = kind.vars[name].type.dtype
            value = wp.from_torch(value.to(torch.int32) if dtype is wp.int32 else value, dtype=dtype)
        setattr(made, name, value)
    return made
