"""Python numbers in a step that is recorded as a CUDA graph: a recording may not copy from the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

from dexsim.errors import UserError

MAKERS = (torch.tensor, torch.as_tensor, torch.asarray)


class Constants(TorchFunctionMode):
    """Make tensors of Python numbers once, on the device of the step.

    A task may write ``torch.tensor([0.05, 0.0, 0.1], device=self.device)`` in any term. The first, unrecorded runs make
    such tensors; a recording gets copies of them, which stay on the device. Without a device they are made on
    the step's.
    """

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device = device
        self.made: dict[Any, torch.Tensor] = {}

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        if func not in MAKERS or not args or not (key := _key(args[0])):
            return func(*args, **kwargs)
        kwargs = {**kwargs, "device": kwargs.get("device") or self.device}
        whole = (key, len(args), str(sorted(kwargs.items(), key=str)))
        if whole not in self.made:
            self.made[whole] = func(*args, **kwargs)
        return self.made[whole].clone()


def _key(data: Any) -> Any:
    """Hash of numbers, nested lists of them or a NumPy array; None of anything else."""
    if isinstance(data, np.ndarray):
        return "array", data.dtype.str, data.shape, data.tobytes()
    if isinstance(data, bool | int | float):
        return type(data).__name__, data
    if isinstance(data, list | tuple):
        parts = tuple(_key(x) for x in data)
        return None if None in parts else ("list", *parts)
    return None


@contextmanager
def unrecordable(task: str) -> Iterator[None]:
    """Say in a line what a recorded step cannot do."""
    try:
        yield
    except RuntimeError as error:
        if "captur" not in str(error):
            raise
        reason = str(error).splitlines()[0]
        raise UserError(
            f"task {task}: its step cannot be recorded as a CUDA graph ({reason}); a term may not read the device"
            " (.item(), if on a tensor, masks as indices) nor copy from the CPU: use torch.where, and make what is"
            " constant in prepare_task"
        ) from error
