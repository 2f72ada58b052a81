"""The peers benchmark: the written scene is a grasp, ratios, refusals."""

from __future__ import annotations

import json
import sys

import mujoco
import numpy as np
import pytest

from benchmarks.peers import __main__ as peers
from benchmarks.peers import scene, sysid
from dexsim.errors import UserError
from dexsim.paths import CONFIGS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    scene.main(str(path))
    return path


def test_the_written_scene_needs_no_files_and_holds_the_box(folder):
    about = json.loads((folder / "scene.json").read_text())
    model = mujoco.MjModel.from_xml_string((folder / "scene.xml").read_text())  # no mesh files beside it
    data = mujoco.MjData(model)
    data.qpos[:12] = data.ctrl[:] = about["start"]
    for k in range(about["closing"] + about["timed"]):
        data.ctrl[:] = about["start"] if k < 17 else about["closed"]
        mujoco.mj_step(model, data, about["decimation"])
    assert data.qpos[14] > 0.03 and data.ncon >= 3 and np.abs(data.qvel[12:15]).max() < 0.2  # in the hand, at rest


def test_the_written_scene_is_the_environments(folder):
    from dexsim.cli import start as start_up
    from dexsim.tasks import make_env

    cfg = start_up.for_train([*scene.SETTINGS, "device=cpu", "worlds=1"], CONFIGS).cfg
    env = make_env(cfg, 1, "cpu", 0, "mujoco")
    model, own = mujoco.MjModel.from_xml_string((folder / "scene.xml").read_text()), env.engine.mjm
    for name in ("timestep", "impratio", "integrator", "cone", "iterations", "ls_iterations"):
        assert getattr(model.opt, name) == getattr(own.opt, name), name
    for g in range(model.ngeom - 1):
        name = model.geom(g).name
        k = own.geom(name).id
        assert np.allclose(model.geom_friction[g], env.engine.field("geom_friction")[0, k], rtol=1e-4), name
        assert np.allclose(model.geom_solref[g], env.engine.field("geom_solref")[0, k], rtol=1e-4), name
    assert np.allclose(model.body_mass[:-1].sum(), own.body_mass[:-1].sum(), rtol=1e-6)
    assert np.allclose(model.geom("box").size, env.objects.size[0].numpy(), rtol=1e-5)


def test_ratios_take_the_better_turn():
    rows = [
        {"name": "dexsim", "ms": 20.0},
        {"name": "bare", "ms": 30.0},
        {"name": "dexsim", "ms": 25.0},
        {"name": "bare", "ms": 18.0},
        {"name": "mjlab", "error": "x"},
    ]
    assert peers.ratios(rows) == {"dexsim": 1.0, "bare": 0.9}
    assert peers.ratios(rows[1:2]) == {}


def test_children_that_fail_are_told(tmp_path):
    assert peers.child([sys.executable, "-c", "print('{\"a\": 1}')"], {}) == {"a": 1}
    assert "status 1: ValueError: no" in peers.child([sys.executable, "-c", "raise ValueError('no')"], {})["error"]
    assert "no end" in peers.child([sys.executable, "-c", "import time; time.sleep(9)"], {}, 0.3)["error"]
    assert peers.interpreter(str(tmp_path))[1]["PYTHONPATH"].startswith(str(tmp_path))
    with pytest.raises(UserError, match="neither an interpreter nor a folder"):
        peers.interpreter("/no/such/python")


@pytest.mark.parametrize(
    "argv, said", [([], "say which"), (["gpu", "wrlds=3"], "unknown setting 'wrlds'"), (["cpu"], "shadow=")]
)
def test_slips_are_one_line(argv, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=said):
        peers.main(argv)


def test_an_effect_that_is_not_named_counts_as_all_wrong():
    rows = [{who: {"error": e, "seconds": s} for who in sysid.WHO} for e, s in ((0.1, 5.0), (None, 7.0), (30.0, 9.0))]
    assert sysid.summary(rows)["diagnose"] == {"error": 1.0, "seconds": 7.0, "n": 3}
