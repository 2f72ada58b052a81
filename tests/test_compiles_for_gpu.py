"""Kernels that are compiled when they are first used on a GPU, compiled for one on a machine without."""

from __future__ import annotations

import pytest
import warp as wp

from dexsim.actuator.columns import FEATURES
from dexsim.actuator.kernel import given_kernel, reset_kernel, send_kernel, servo_kernel
from dexsim.gap.plant.kernel import plant_kernel

KERNELS = {
    "a joint of a diagnosis": plant_kernel,
    "servo": lambda: servo_kernel(wp.float32, False),
    "servo, voltage, every law": lambda: servo_kernel(wp.float32, True, frozenset(FEATURES)),
    "sent targets": lambda: send_kernel(wp.float32),
    "reset servos": lambda: reset_kernel(wp.float32),
    "given drives": lambda: given_kernel(wp.float32),
}


@pytest.mark.parametrize("what", KERNELS)
def test_a_kernel_compiles_for_a_gpu(what, tmp_path):
    wp.compile_aot_module(KERNELS[what]().module, arch=90, module_dir=str(tmp_path), use_ptx=True)
    assert [p.stat().st_size > 1000 for p in tmp_path.glob("*.ptx")] == [True]
