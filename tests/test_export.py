"""Policy bundles: the exported network is the trained one, the manifest says what its inputs are, and changes are
noticed."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import yaml
from bundles import make_checkpoint

from dexsim import export
from dexsim.deploy import bundle
from dexsim.deploy.of_grasp import Measured
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.tasks import observations
from tools.assets import xhand


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return (checkpoint, bundle folder)."""
    folder = tmp_path_factory.mktemp("bundle")
    source = make_checkpoint(folder / "policy.pt")
    return source, export.export(str(source), folder / "out", steps=20)


@pytest.fixture
def copy(made, tmp_path):
    import shutil

    return shutil.copytree(made[1], tmp_path / "copy")


def test_the_network_is_the_checkpoints_with_its_normalization_inside(made):
    """Against a forward pass written out here from the checkpoint's tensors."""
    a = {k: v.double().numpy() for k, v in checkpoint.load(made[0])["actor"].items()}
    x = np.random.default_rng(0).normal(0, 2, (40, 66))
    h = (x - a["obs_normalizer._mean"]) / (a["obs_normalizer._std"] + 1e-2)
    for k in (0, 2):
        h = h @ a[f"mlp.{k}.weight"].T + a[f"mlp.{k}.bias"]
        h = np.where(h > 0, h, np.expm1(np.minimum(h, 0)))
    want = h @ a["mlp.4.weight"].T + a["mlp.4.bias"]
    got = bundle.load(made[1]).act(x)
    np.testing.assert_allclose(got, want, atol=2e-5)
    assert np.abs(want).max() > 0.1, "a network that says nothing would pass"


def test_one_file_and_no_other_data(made):
    assert sorted(p.name for p in made[1].iterdir()) == ["config.yaml", "golden.npz", "manifest.yaml", "policy.onnx"]


def test_manifest_tables_cover_the_observation(made):
    m = bundle.load(made[1]).manifest
    edges = [(r["start"], r["stop"]) for r in m["observation"]]
    assert edges[0][0] == 0 and edges[-1][1] == 66 == m["policy"]["observation_size"]
    assert all(a[1] == b[0] for a, b in zip(edges[:-1], edges[1:], strict=True))
    assert all(r["unit"] and r["frame"] and r["scaling"] and r["order"] for r in m["observation"])
    assert m["joints"] == list(xhand.JOINTS) and m["fingers"] == list(xhand.FINGERS)
    np.testing.assert_allclose(m["action"]["low"], xhand.joint_limits()[:, 0], atol=1e-6)
    np.testing.assert_allclose(m["normalization"]["tau_max"], xhand.efforts(), atol=1e-6)
    assert m["rates"]["policy_period_s"] == pytest.approx(0.021) and m["normalization"]["force_max_N"] > 1
    assert set(m["versions"]["exported_with"]) >= {"torch", "onnxruntime"} and m["trained"]["iteration"] == 3
    assert m["trained"]["git"] == {"commit": "unknown", "dirty": False}


def test_check_passes_and_names_largest_differences(made, capsys):
    assert export.check(made[1])
    assert capsys.readouterr().out.count("ok") == 4


@pytest.mark.slow
def test_check_notices_a_wrong_output_observation_or_target(copy):
    for key, where in (("action", (3, 2)), ("signal_fingertip", (2, 1, 0)), ("target", (4, 5))):
        rows = dict(np.load(copy / "golden.npz"))
        whole = {k: v.copy() for k, v in rows.items()}
        rows[key][where] += 1e-3
        np.savez_compressed(copy / "golden.npz", **rows)
        assert not export.check(copy), key
        np.savez_compressed(copy / "golden.npz", **whole)
    assert export.check(copy)


def test_a_changed_policy_is_refused(copy):
    data = bytearray((copy / "policy.onnx").read_bytes())
    data[len(data) // 2] ^= 1
    (copy / "policy.onnx").write_bytes(data)
    with pytest.raises(UserError, match="sha256"):
        bundle.load(copy)


@pytest.mark.parametrize("edit, says", [
    (lambda m: m.update(version=9), "version 9"),
    (lambda m: m.pop("rates"), "rates"),
    (lambda m: m.update(format="x"), "not the manifest"),
])  # fmt: skip
def test_bad_manifests_are_named(copy, edit, says):
    m = yaml.safe_load((copy / "manifest.yaml").read_text())
    edit(m)
    (copy / "manifest.yaml").write_text(yaml.safe_dump(m))
    with pytest.raises(UserError, match=says):
        bundle.load(copy)


def test_another_observation_table_is_refused(copy):
    m = yaml.safe_load((copy / "manifest.yaml").read_text())
    m["observation"][4]["unit"] = "N"
    (copy / "manifest.yaml").write_text(yaml.safe_dump(m))
    with pytest.raises(UserError, match="contact_force"):
        export.check(copy)


def test_calibration_is_carried(made, tmp_path):
    (tmp_path / "calibration.yaml").write_text(
        yaml.safe_dump({"joints": {"mid_joint1": {"current_per_torque": 1.9}}, "touch": {"lsb": 0.08}})
    )
    out = export.export(str(made[0]), tmp_path / "out", str(tmp_path / "calibration.yaml"), steps=4)
    c = bundle.load(out).manifest["calibration"]
    assert c["joints"]["mid_joint1"]["current_per_torque"] == 1.9 and c["touch"]["lsb"] == 0.08


def test_command_line_errors_are_one_line(made, tmp_path):
    for arguments, says in (
        (["checkpoint=nowhere.pt", f"out={tmp_path / 'x'}"], "nowhere.pt"),
        (["check=nowhere"], "manifest.yaml"),
        (["chekpoint=a"], "chekpoint"),
        ([f"checkpoint={made[0]}"], "out="),
        ([f"checkpoint={made[0]}", f"out={made[1]}"], "already holds"),
    ):
        with pytest.raises(UserError, match=says) as caught:
            export.main(arguments)
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_module_checks_in_its_own_process(made):
    command = [sys.executable, "-m", "dexsim", "export", f"check={made[1]}"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count("ok") == 4


def test_builder_places_every_signal():
    """Each signal set to a value of its own lands in its own slice, scaled as the table says."""
    one = lambda k, *shape: np.full(shape, float(k), np.float32)  # noqa: E731
    given = dict(
        joint_position=one(1, 12), joint_torque=one(2, 12), object_xy=one(3, 2), object_z=one(4), object_vz=one(5),
        touch_force=one(6, 5), touch_centre=one(7, 5, 3), fingertip=one(8, 5, 3), command=one(9),
    )  # fmt: skip
    widths = {"joint_angle": 12, "joint_torque": 12, "object_position": 3, "object_velocity": 3, "contact_force": 5,
              "contact_centre": 15, "fingertip_position": 15, "force_command": 1}  # fmt: skip
    measured = Measured.__new__(Measured)
    measured.manifest = {"observation": [{"name": name} for name in widths], "normalization": {"force_max_N": 2.0}}
    out, at = measured.built(given), observations.slices([*widths.items()])
    assert out.shape == (1, 66)
    for name, want in (("joint_angle", 1), ("joint_torque", 2), ("contact_force", 3), ("contact_centre", 7),
                       ("fingertip_position", 8), ("force_command", 9)):  # fmt: skip
        assert (out[:, at[name]] == want).all(), name
    assert out[0, at["object_position"]].tolist() == [3, 3, 4] and out[0, at["object_velocity"]].tolist() == [0, 0, 5]
