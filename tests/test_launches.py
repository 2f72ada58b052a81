"""How many kernels a control step launches beside its physics: on a GPU their number is what the step costs, and one
line of torch too many is easily written. Counted, not timed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp
from worlds import task_cfg

from dexsim.sim import warmup
from dexsim.tasks import make_env
from tests import launches

MOST = {"grasp": 110, "rotate": 490}
"""As a GPU has them by default, 107 and 482 were counted when this was written."""


@pytest.mark.parametrize("task", sorted(MOST))
def test_a_control_step_launches_few_kernels(task):
    env = make_env(task_cfg("preset=cuda", task=task, worlds=4), 4, "cpu", 0, "warp")
    found = launches.count(env, torch.zeros(4, env.num_actions))
    total = sum(sum(part.values()) for part in found.values())
    lines = sum(found.values(), launches.Counter()).most_common(8)
    assert all(found[name] for name in launches.PARTS), "a part launches nothing: it was not counted"
    assert total <= MOST[task], "\n".join(f"{n} {line}" for line, n in lines)
    env.close()


@pytest.mark.parametrize("task", sorted(MOST))
def test_what_a_step_launches_is_compiled_at_once(task, monkeypatch):
    """Each module of a step is named before the first one: a GPU compiles one named later by itself."""
    env = make_env(task_cfg(task=task, worlds=4), 4, "cpu", 0, "warp")
    named = {module for program in (env.engine._one_step, env._name_kernels) for module, _ in warmup.listed(program)}
    launched, launch = set(), wp.launch

    def noted(kernel, dim, *args, **kwargs):
        if np.prod(dim):
            launched.add(kernel.module)
        return launch(kernel, dim, *args, **kwargs)

    monkeypatch.setattr(wp, "launch", noted)
    with launches.as_on_a_gpu(env):
        for _ in range(3):
            env.step(torch.zeros(4, env.num_actions))
    env.close()
    assert launched and launched <= named, {m.name for m in launched - named}


def test_what_is_counted():
    x = torch.ones(3, 4)
    with launches.counting() as found:
        x.T.reshape(2, 6)  # a copy: the transposed is no view of that shape
        x.view(-1)[2:].unsqueeze(0)
        torch.empty(5)
        (x + 1).mul_(2)
    assert sum(found.values()) == 3
