"""Constants of a task's step: made once on the device, handed out as copies."""

import numpy as np
import pytest
import torch

from dexsim.errors import UserError
from dexsim.tasks.recorded import Constants, unrecordable


def test_constants_equal_what_torch_makes_and_are_copies():
    saved = Constants("cpu")
    for _ in range(2):
        with saved:
            a = torch.tensor([0.05, 0.0, 1])
            b = torch.as_tensor(np.arange(4.0), dtype=torch.float32)
            c = torch.tensor([1, 2], dtype=torch.long)
            a += 1  # a term may change what it made
        assert torch.equal(a, torch.tensor([0.05, 0.0, 1]) + 1)
        assert torch.equal(b, torch.arange(4.0)) and b.dtype == torch.float32
        assert torch.equal(c, torch.tensor([1, 2]))


def test_the_device_is_copied_to_once(monkeypatch):
    """The second run of a step makes no tensor of Python numbers, which a recording could not."""
    saved, made = Constants("cpu"), []
    for _ in range(3):
        with saved:
            made.append((torch.tensor([1.0, 2.0]), torch.tensor(2.0), torch.tensor(True), torch.tensor([[1], [2]])))
    assert len(saved.made) == 4
    assert all(torch.equal(x, y) for x, y in zip(made[0], made[2], strict=True))


def test_equal_numbers_of_other_types_are_other_constants():
    with Constants("cpu"):
        assert torch.tensor(1).dtype == torch.int64
        assert torch.tensor(1.0).dtype == torch.float32
        assert torch.tensor(True).dtype == torch.bool


def test_a_device_that_is_asked_for_is_taken():
    with Constants("meta"):
        assert torch.tensor([1.0]).device.type == "meta"
        assert torch.tensor([1.0], device="cpu").device.type == "cpu"


def test_what_cannot_be_recorded_is_one_line():
    with pytest.raises(UserError, match=r"task lift: its step cannot be recorded .*torch\.where"), unrecordable("lift"):
        raise RuntimeError("Cannot copy between CPU and CUDA tensors during CUDA graph capture\nmore")
    with pytest.raises(RuntimeError, match="shape"), unrecordable("lift"):
        raise RuntimeError("shape mismatch")
