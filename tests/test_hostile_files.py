"""Files that carry code: none of it runs, whatever opens them. And checkpoints and bundles of wrong parts: one line
each."""

from __future__ import annotations

import copy
import gzip
import io
import json
import os
import pickle
import shutil
import sys
import tarfile
import time
import zipfile

import dummy_task
import numpy as np
import pytest
import torch
import yaml
from bundles import make_checkpoint
from shell import call, configs
from test_learning import runner

from dexsim import export, yaml_text
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy
from dexsim.learning.runner import Runner

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def payload():
    made = runner()
    made.learn(1)
    return made.payload()


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A module `trap` on the path, and what shows that it, or a pickle, ran: the file RAN."""
    ran = tmp_path / "RAN"
    (tmp_path / "trap.py").write_text(f"""
from pathlib import Path
Path({str(ran)!r}).write_text("imported")
def go(*a, **k):
    Path({str(ran)!r}).write_text("called")
    raise RuntimeError("it ran")
class Net:
    def __init__(self, *a, **k): go()
""")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield ran
    sys.modules.pop("trap", None)


def bait(ran):
    """Return an object whose unpickling writes the file."""

    class Bait:
        def __reduce__(self):
            return exec, (f"open({str(ran)!r}, 'w').close()",)

    return Bait()


def one_line(error) -> str:
    text = str(error.value)
    assert "\n" not in text and 10 < len(text) < 700, text
    return text


# -- names of classes in the stored settings
# ---------------------------------------------------------------------------------
NAMED = [
    ("actor.class_name", "trap:Net"),
    ("actor.class_name", "trap.Net"),
    ("actor.class_name", "os:system"),
    ("actor.distribution_cfg.class_name", "trap:Net"),
    ("critic.class_name", "trap:go"),
    ("critic.distribution_cfg", {"class_name": "trap:go"}),
    ("algorithm.class_name", "trap:Net"),
    ("algorithm.class_name", "builtins:exec"),
    (
        "algorithm.symmetry_cfg",
        {"use_data_augmentation": True, "use_mirror_loss": False, "data_augmentation_func": "trap:go"},
    ),
    ("algorithm.rnd_cfg", {"class_name": "trap:Net"}),
    ("logger", {"class_name": "trap:Net"}),
    ("logger", "wandb"),
    ("_target_", "trap.go"),
    ("actor._target_", "trap.go"),
    ("class_name", "trap:Net"),
]


def set_in(node, key, value):
    *path, last = key.split(".")
    for part in path:
        node = node[part]
    node[last] = value


@pytest.mark.parametrize("key, value", NAMED)
def test_a_class_that_a_checkpoint_names_is_neither_imported_nor_called(payload, trap, tmp_path, key, value):
    evil = copy.deepcopy(payload)
    set_in(evil["config"]["agent"], key, value)
    data = checkpoint.load(checkpoint.save(tmp_path / "evil.pt", evil))
    env = dummy_task.make_env(data["config"], 4, "cpu", 0, "none")
    with pytest.raises(UserError, match="names code to run.*type agent\\.") as error:
        load_policy(data, env, "evil.pt")
    one_line(error)
    with pytest.raises(UserError, match="names code to run"):
        Runner(env, data["config"], {}).open_writer(tmp_path)
    assert not trap.exists() and "trap" not in sys.modules


@pytest.mark.parametrize("sizes", [[10**9] * 3, [16_384] * 9, [], "x", [0.5]])
def test_a_network_that_no_memory_holds_is_not_built(payload, sizes):
    from dexsim.learning import ppo

    big = copy.deepcopy(payload["config"])
    big["agent"]["actor"]["hidden_dims"] = sizes
    with pytest.raises(UserError, match="x.pt: agent.actor.hidden_dims"):
        ppo.agent_config(big, "cpu", where="x.pt")


def test_a_class_that_the_user_types_is_used(payload, trap, tmp_path, capsys):
    """play.py with the checkpoint refuses; the same with the name typed calls it."""
    evil = copy.deepcopy(payload)
    evil["config"]["agent"]["actor"]["class_name"] = "trap:Net"
    evil["config"] = config_of_a_run(evil["config"])
    where, out = checkpoint.save(tmp_path / "evil.pt", evil), f"out={tmp_path / 'out'}"
    assert call("play", configs(tmp_path), f"checkpoint={where}", out, "device=cpu") == 2
    assert "agent.actor.class_name=trap:Net names code" in capsys.readouterr().err and not trap.exists()
    assert call("train", tmp_path / "configs", f"resume={where}", "iterations=3", f"{out}2", "device=cpu") == 2
    assert "agent.actor.class_name=trap:Net names code" in capsys.readouterr().err and not trap.exists()
    with pytest.raises(RuntimeError, match="it ran"):
        call("play", tmp_path / "configs", f"checkpoint={where}", out, "device=cpu", "agent.actor.class_name=trap:Net")
    assert trap.read_text() == "called"


def config_of_a_run(cfg):
    """Return the whole config of a run on the dummy task, with the agent of `cfg`."""
    base = {
        "choices": {"task": "dummy"},
        "worlds": 4,
        "iterations": 2,
        "preset": "none",
        "device": "cpu",
        "run": None,
        "out": None,
        "resume": None,
        "sim": {"engine": "auto"},
        "tactile": {"raw": False},
        "save_interval": 10,
        "final_episodes": 0,
        "servo_file": None,
        "servo": {},
        "randomize": {},
    }
    return base | {k: v for k, v in cfg.items() if k in ("agent", "seed")} | {"task": {"name": "dummy", "steps": 20}}


def test_a_stored_setting_reads_no_environment(payload, tmp_path):
    evil = copy.deepcopy(payload)
    evil["config"]["task"]["name"] = "${oc.env:HOME}"
    with pytest.raises(UserError, match="interpolation"):
        checkpoint.load(checkpoint.save(tmp_path / "evil.pt", evil))


# -- archives
# -------------------------------------------------------------------------------------------------------------------
def whole(tmp_path, payload) -> bytes:
    return checkpoint.save(tmp_path / "good.pt", payload).read_bytes()


def torch_file(data, **how) -> bytes:
    buffer = io.BytesIO()
    torch.save(data, buffer, **how)
    return buffer.getvalue()


def zipped(parts: dict[str, bytes], how=zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", how) as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def tarred(parts: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, data in parts.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return buffer.getvalue()


def script_module(bad) -> bytes:
    buffer = io.BytesIO()
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), buffer)
    return buffer.getvalue()


def with_part(data: bytes, name: str, part: bytes) -> bytes:
    buffer = io.BytesIO(data)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(name, part)
    return buffer.getvalue()


ARCHIVES = {
    "a raw pickle": lambda good, bad: pickle.dumps(bad),
    "a raw pickle of protocol 0": lambda good, bad: pickle.dumps(bad, 0),
    "a raw pickle, then a whole checkpoint": lambda good, bad: pickle.dumps(bad) + good,
    "a pickle of protocol 0, then a whole checkpoint": lambda good, bad: pickle.dumps(bad, 0) + good,
    "a whole checkpoint, then a pickle": lambda good, bad: good + pickle.dumps(bad),
    "torch's old format": lambda good, bad: torch_file(
        {"format": checkpoint.FORMAT, "x": bad}, _use_new_zipfile_serialization=False
    ),
    "torch's zip": lambda good, bad: torch_file({"format": checkpoint.FORMAT, "version": 1, "x": bad}),
    "code as a key": lambda good, bad: torch_file({"format": checkpoint.FORMAT, bad: 1}),
    "a tar, as torch once wrote": lambda good, bad: tarred(
        {"sys_info": pickle.dumps(bad), "pickle": pickle.dumps(bad)}
    ),
    "a tar and a zip in one": lambda good, bad: tarred({"pickle": pickle.dumps(bad)}) + good,
    "a compiled module": lambda good, bad: script_module(bad),
    "a zip of code": lambda good, bad: zipped({"archive/data.pkl": pickle.dumps(bad), "archive/version": b"3"}),
    "a compressed zip": lambda good, bad: zipped({"archive/data.pkl": pickle.dumps(bad)}, zipfile.ZIP_DEFLATED),
    "a gzip": lambda good, bad: gzip.compress(pickle.dumps(bad)),
    "python's own archive": lambda good, bad: zipped({"__main__.py": b"import trap"}),
    "two parts of one name": lambda good, bad: with_part(
        good, zipfile.ZipFile(io.BytesIO(good)).namelist()[0], pickle.dumps(bad)
    ),
    "numpy objects": lambda good, bad: npz(bad),
}


def npz(bad) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, observation=np.array([bad], object))
    return buffer.getvalue()


@pytest.mark.parametrize("kind", ARCHIVES)
@pytest.mark.filterwarnings("ignore")
def test_an_archive_that_holds_code_runs_none(payload, trap, tmp_path, kind):
    file = tmp_path / "evil.pt"
    file.write_bytes(ARCHIVES[kind](whole(tmp_path, payload), bait(trap)))
    try:
        checkpoint.load(file)
    except UserError as error:
        assert "\n" not in str(error)
    else:
        assert kind == "a whole checkpoint, then a pickle", (
            "only this one is a checkpoint, with bytes that nothing reads"
        )
    assert not trap.exists()


@pytest.mark.limits
def test_a_part_that_unpacks_without_end_is_refused_soon(tmp_path):
    file = tmp_path / "bomb.pt"
    file.write_bytes(zipped({"archive/data.pkl": bytes(200 << 20)}, zipfile.ZIP_DEFLATED))
    begun = time.process_time()
    with pytest.raises(UserError, match="bomb.pt: damaged"):
        checkpoint.load(file)
    assert time.process_time() - begun < 0.2


# -- YAML, npz, ONNX
# ---------------------------------------------------------------------------------------------------------------
TAGS = [
    "!!python/object/apply:trap.go []",
    "!!python/object/new:trap.Net []",
    "!!python/name:trap.go ''",
    "!!python/module:trap ''",
    "!!python/object:trap.Net {}",
]


@pytest.mark.parametrize("tag", TAGS)
def test_yaml_tags_build_nothing(trap, tmp_path, tag):
    from dexsim.actuator.table import ServoTable
    from dexsim.calibration.file import Calibration
    from dexsim.deploy import bundle

    text = f"format: dexsim-bundle\nversion: 1\nschema: 1\nx: {tag}\n"
    for name in ("manifest.yaml", "file.yaml"):
        (tmp_path / name).write_text(text)
    for opens in (
        lambda: bundle.load(tmp_path),
        lambda: Calibration.load(tmp_path / "file.yaml"),
        lambda: ServoTable.load(tmp_path / "file.yaml"),
    ):
        with pytest.raises(UserError) as error:
            opens()
        one_line(error)
    assert not trap.exists()


LIMITS = {
    "aliases of aliases": "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n"
    + "".join(f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12)),
    "merges of merges": "a0: &a0 {k: 1}\n"
    + "".join(f"a{k}: &a{k}\n  <<: [{','.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12)),
    "lists in lists": "[" * 5000,
    "maps in maps": "{a: " * 5000,
    "a list that holds itself": "a: &a [*a]",
    "a date that is none": "x: !!timestamp 2020-99-99",
    "a set": "x: !!set {a}",
    "half a character": 'x: "\\ud800"',
    "a key twice": "x: 1\ny: 2\nx: 3",
    "a number of 5000 digits": "x: " + "1" * 5000,
    "a list as a key": "? [a]\n: b",
    "no text": "\x00",
}


@pytest.mark.limits
@pytest.mark.parametrize("kind", LIMITS)
def test_yaml_keeps_its_limits(kind):
    begun = time.process_time()
    with pytest.raises(UserError, match="^file.yaml: ") as error:
        yaml_text.parse(LIMITS[kind], "file.yaml")
    one_line(error)
    assert time.process_time() - begun < 1.0


def test_yaml_within_limits_reads_as_ever():
    text = yaml.safe_dump({"a": [1, 2.5, None, True, "x"], "b": {"c": [[1], [2]]}, "d": (same := [1, 2]), "e": same})
    assert "*id" in text and yaml_text.parse(text, "x") == yaml.safe_load(text)
    assert yaml_text.parse("", "x") is None


@pytest.fixture(scope="module")
def bundled(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    return export.export(str(make_checkpoint(folder / "policy.pt")), folder / "out", steps=2)


@pytest.fixture
def b(bundled, tmp_path):
    return shutil.copytree(bundled, tmp_path / "bundle")


def sealed(folder, data: bytes) -> None:
    """Put a network into a bundle, its digest with it."""
    import hashlib

    (folder / "policy.onnx").write_bytes(data)
    m = yaml.safe_load((folder / "manifest.yaml").read_text())
    m["policy"]["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / "manifest.yaml").write_text(yaml.safe_dump(m))


def test_objects_in_golden_arrays_stay_pickled(b, trap):
    (b / "golden.npz").write_bytes(npz(bait(trap)))
    with pytest.raises(UserError, match="golden.npz") as error:
        export.check(b)
    one_line(error)
    assert not trap.exists()


@pytest.mark.parametrize("where", ["initializer", "attribute", "branch"])
def test_a_network_reads_no_other_file(b, tmp_path, where, monkeypatch):
    import onnx
    from onnx import TensorProto, helper

    (tmp_path / "secret.bin").write_bytes(np.ones(66 * 12, np.float32).tobytes())
    away = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[66, 12], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", "../secret.bin"), ("offset", "0"), ("length", str(66 * 12 * 4))):
        entry = away.external_data.add()
        entry.key, entry.value = key, value
    x, y = (
        helper.make_tensor_value_info("observation", 1, ["n", 66]),
        helper.make_tensor_value_info("action", 1, ["n", 12]),
    )
    nodes, weights = [helper.make_node("MatMul", ["observation", "w"], ["action"])], [away]
    constant = helper.make_node("Constant", [], ["w"], value=away)
    if where == "attribute":
        nodes, weights = [constant, *nodes], []
    elif where == "branch":
        inner = helper.make_graph([constant], "inner", [], [helper.make_tensor_value_info("w", 1, [66, 12])])
        yes = helper.make_tensor("yes", TensorProto.BOOL, [], [True])
        nodes = [helper.make_node("If", ["yes"], ["w"], then_branch=inner, else_branch=inner), *nodes]
        weights = [yes]
    model = helper.make_model(
        helper.make_graph(nodes, "g", [x], [y], weights), opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    )
    assert onnx.ModelProto.FromString(model.SerializeToString()) == model
    sealed(b, model.SerializeToString())
    monkeypatch.chdir(b)  # where a network without a folder would look
    with pytest.raises(UserError, match="kept in another file") as error:
        export.check(b)
    one_line(error)


def test_a_network_of_other_sizes_or_of_nonsense_is_named(b):
    from onnx import helper

    x, y = (
        helper.make_tensor_value_info("observation", 1, ["n", 66]),
        helper.make_tensor_value_info("action", 1, ["n", 66]),
    )
    model = helper.make_model(
        helper.make_graph([helper.make_node("Identity", ["observation"], ["action"])], "g", [x], [y]),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )
    sealed(b, model.SerializeToString())
    with pytest.raises(UserError, match=r"shape \[1, 66\], must give floats of shape \[1, 12\]"):
        export.check(b)
    model.graph.node[0].op_type, model.graph.node[0].domain = "Run", "trap"
    sealed(b, model.SerializeToString())
    with pytest.raises(UserError, match="onnxruntime cannot load"):
        export.check(b)
    sealed(b, b"not a network")
    with pytest.raises(UserError, match="not an ONNX network|cannot load"):
        export.check(b)


# -- parts of the wrong kind
# -----------------------------------------------------------------------------------------------------
WRONG = [
    ("kind", "other"),
    ("kind", 3),
    ("kind", []),
    ("config", None),
    ("config", "x"),
    ("config", {"agent": []}),
    ("config", []),
    ("versions", []),
    ("versions", {"dexsim": 1}),
    ("git", None),
    ("git", {"commit": 1, "dirty": False}),
    ("layout", []),
    ("layout", {}),
    ("layout", {"joints": 3, "action": [], "observations": {}}),
    ("layout", {"joints": ["a"], "action": [], "observations": {"actor": [["x"]]}}),
    ("iteration", "3"),
    ("iteration", -1),
    ("iteration", None),
    ("iteration", float("nan")),
    ("steps", [1]),
    ("steps", 2**70),
    ("actor", []),
    ("actor", {"w": 1.0}),
    ("actor", {1: torch.zeros(1)}),
    ("critic", None),
    ("critic", {"w": [1.0]}),
    ("optimizer", {}),
    ("optimizer", {"state": [], "param_groups": {}}),
    ("optimizer", {"state": {}, "param_groups": []}),
    ("optimizer", {"state": {0: {"step": "x"}}, "param_groups": [{"params": [0]}]}),
    ("env", None),
    ("env", {}),
    ("env", {"x": torch.zeros(99)}),
    ("rng", {}),
    ("rng", {"torch": 1, "cuda": [], "numpy": [], "python": []}),
    ("actor", {"w": torch.zeros(1).expand(10**9)}),
    ("actor", {"w": torch.tensor([1.0, float("nan")])}),
    ("critic", {"w": torch.tensor([float("inf")])}),
]


@pytest.mark.parametrize("part, value", WRONG, ids=[f"{k}-{p}" for k, (p, _) in enumerate(WRONG)])
def test_a_part_of_the_wrong_kind_is_named(payload, tmp_path, part, value):
    buffer = io.BytesIO()
    text = json.dumps(value if part == "config" else payload["config"])
    torch.save({"format": checkpoint.FORMAT, "version": 1, **payload, part: value, "config": text}, buffer)
    (tmp_path / "wrong.pt").write_bytes(buffer.getvalue())
    with pytest.raises(UserError, match=f"{part}|networks of this run") as error:
        data = checkpoint.load(tmp_path / "wrong.pt")
        again = runner()
        again.restore(data, "wrong.pt")
    assert "wrong.pt" in one_line(error)


def edits():
    nan, inf = float("nan"), float("inf")
    yield from (
        ("policy", None),
        ("policy", "x"),
        ("policy.sha256", 1),
        ("policy.observation_size", "66"),
        ("policy.observation_size", 67),
        ("policy.action_size", 5),
        ("policy.input", "other"),
        ("policy.output", None),
        ("observation", {}),
        ("observation", []),
        ("observation.0.start", 3),
        ("observation.0", None),
        ("joints", None),
        ("joints", ["a"]),
        ("fingers", "thumb"),
        ("action", []),
        ("action.mode", "fast"),
        ("action.scale", nan),
        ("action.scale", "0.1"),
        ("action.lead", -1.0),
        ("action.lead", [0.1]),
        ("action.low", [0.0]),
        ("action.low.3", nan),
        ("action.low.3", -9.0),
        ("action.high.3", inf),
        ("action.high.0", -2.0),
        ("action.high.5", 40.0),
        ("action.speed_limit_rad_s.2", 0.0),
        ("action.speed_limit_rad_s.2", 1e6),
        ("rates", 5),
        ("rates.policy_period_s", 0),
        ("rates.policy_period_s", nan),
        ("rates.policy_period_s", "1e-2 s"),
        ("normalization.tau_max", [1] * 11),
        ("normalization.tau_max.1", -1.0),
        ("normalization.force_max_N", None),
        ("normalization.force_max_N", 0),
        ("initial_pose.4", 9.0),
        ("initial_pose", "open"),
        ("golden.tolerance", "x"),
        ("golden", None),
        ("task", "walk"),
        ("task", ["grasp"]),
        ("calibration", 3),
        ("calibration.touch", "x"),
        ("versions", 1),
        ("servo", []),
        ("task", "rotate"),
        ("version", "1"),
        ("format", None),
        ("hand.name", "é\u202e"),
        ("hand.name", "../../elsewhere"),
        ("hand.name", None),
        ("hand.folder", "hand"),
        ("hand.folder", "../elsewhere"),
        ("hand.scale", 7.0),
        ("hand.mirror", "yes"),
        ("hand", ["xhand"]),
    )


@pytest.mark.parametrize("key, value", list(edits()))
def test_a_manifest_of_the_wrong_kind_is_named(b, tmp_path, key, value):
    from dexsim.cli.deploy import main

    m = yaml.safe_load((b / "manifest.yaml").read_text())
    node, (*path, last) = m, key.split(".")
    for part in path:
        node = node[int(part) if isinstance(node, list) else part]
    node[int(last) if isinstance(node, list) else last] = value
    (b / "manifest.yaml").write_text(yaml.safe_dump(m))
    with pytest.raises(UserError) as error:
        main([f"bundle={b}", "record=none", "driver=xhand"])  # ends before a hand is asked for
    assert "manifest" in (text := one_line(error)) or "calibration" in text or "policy.onnx" in text, text


WORLD = "</worldbody>"
COPIES = '<replicate count="999999"><geom size=".1"/></replicate></worldbody>'
MODELS = {
    "pipe in meshdir": ("<asset>", '<asset><mesh name="x" file="inner.obj"/>', "a pipe|no such file"),
    "pipe included by an included one": ("<asset>", '<include file="more.xml"/><asset>', "names a pipe"),
    "copies": (WORLD, COPIES, "takes more than"),
    "copies that no parser of ours sees": (WORLD, "<!-- \x01 -->" + COPIES, "takes more than|is not XML"),
    "heights": ("<asset>", '<asset><hfield name="h" nrow="99999" ncol="99999" size="1 1 1 1"/>',
                r"more than 1(\.01)? GiB"),  # fmt: skip
    "figures of users": ("<asset>", '<size nuser_body="1000000000"/><asset>', r"more than 1(\.01)? GiB"),
}


READERS = ("hand", "model=", "model_file=", "import-hand")


def pairs():
    """Yield each kind with each reader; quick are all kinds with one reader, and one kind with all of them."""
    for reader in READERS:
        for kind in MODELS:
            quick = reader == "hand" or kind == "pipe included by an included one"
            yield pytest.param(kind, reader, marks=[] if quick else [pytest.mark.slow])


@pytest.mark.limits
@pytest.mark.parametrize(("kind", "reader"), list(pairs()))
def test_a_model_that_would_hang_or_fill_the_memory_is_refused(kind, reader, tmp_path, monkeypatch):
    """Each as a hand's own, a diagnosis', a training's and one to be imported, in one line."""
    from dexsim import guard
    from dexsim.hand import load_hand
    from dexsim.hand.load import HANDS
    from dexsim.import_hand import source
    from dexsim.paths import CONFIGS
    from dexsim.recording.mechanism import mechanism
    from dexsim.tasks.building import model_of

    monkeypatch.setattr(guard, "SECONDS", 1.0)
    monkeypatch.setattr(guard, "WAITING_S", 0.3)
    folder = tmp_path / "a" / "hand"
    shutil.copytree(HANDS / "xhand", folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    text = (folder / "hand.yaml").read_text().replace("../../configs/servo/xhand.yaml", "servo.yaml")
    (folder / "hand.yaml").write_text(text)
    shutil.copy(CONFIGS / "servo" / "xhand.yaml", folder / "servo.yaml")
    for name in ("pipe.xml", "meshes/inner.obj"):
        os.mkfifo(folder / name)
    (folder / "more.xml").write_text('<mujoco><include file="pipe.xml"/></mujoco>')
    here, there, said = MODELS[kind]
    model = folder / "xhand_right.xml"
    assert here in (sound := model.read_text())
    model.write_text(sound.replace(here, there, 1))
    read = {
        "hand": lambda: load_hand(folder),
        "model=": lambda: mechanism(model, folder / "servo.yaml"),
        "model_file=": lambda: model_of(load_hand("xhand"), str(model)),
        "import-hand": lambda: source.read(model, []),
    }[reader]
    with pytest.raises(UserError, match=said) as error:
        read()
    assert "xhand_right.xml" in (text := one_line(error)), text


@pytest.mark.limits
def test_what_is_taken_out_of_a_model_is_taken_out_within_limits(tmp_path, monkeypatch):
    """MuJoCo looks for a keyframe among all of them, to take it out."""
    from dexsim import guard
    from dexsim.recording.mechanism import mechanism

    monkeypatch.setattr(guard, "SECONDS", 1.0)
    keys = "".join(f'<key name="{k}"/>' for k in range(30_000))
    body = '<worldbody><body><joint name="a"/><geom size=".1"/></body></worldbody>'
    (tmp_path / "m.xml").write_text(f"<mujoco>{body}<keyframe>{keys}</keyframe></mujoco>")
    with pytest.raises(UserError, match="m.xml: takes more than 1 s"):
        mechanism(tmp_path / "m.xml", {"drive": "torque", "joints": {"*": {"kp": 1.0}}})


def test_an_object_that_is_named_twice_is_said():
    from dexsim.assets.objects import own

    with pytest.raises(UserError, match="train: 'box' stands twice"):
        own.named({"train": ["box", "sphere", "box"], "held_out": []})


@pytest.fixture(scope="module")
def grasping():
    from dexsim.cli import start
    from dexsim.paths import CONFIGS

    return start.for_train(["task=grasp", "device=cpu", "worlds=2"], CONFIGS).cfg


NAMES = ("a" * 5000, "a/" * 3000, "~nobody_of_this_name/x.obj", "x\0y.obj", "/proc/1/map_files", "\x1b[2J\u202e\ud800")


@pytest.mark.parametrize("name", NAMES, ids=["long", "deep", "nobody's", "a zero", "not ours", "not printable"])
@pytest.mark.parametrize("key", ["objects", "kept_out", "hand", "model_file", "task.evaluation.base"])
def test_a_name_that_no_file_can_have_is_one_line(payload, grasping, tmp_path, key, name):
    """In a checkpoint's settings, as they are built."""
    from dexsim.assets.objects import own
    from dexsim.cli import start
    from dexsim.hand import load_hand
    from dexsim.paths import CONFIGS
    from dexsim.tasks import base_path
    from dexsim.tasks.building import model_of

    config = copy.deepcopy(grasping)
    uses = {"objects": lambda: own.own_shape(name), "kept_out": lambda: own.own_shape(name),
            "hand": lambda: load_hand(name), "model_file": lambda: model_of(load_hand("xhand"), name),
            "task.evaluation.base": lambda: base_path.of(name if name.endswith(".csv") else f"{name}.csv")}  # fmt: skip
    with pytest.raises(UserError) as error:
        uses[key]()
    assert one_line(error).isprintable()
    if key in ("objects", "kept_out", "hand"):
        config[key] = name if key == "hand" else [name]
        checkpoint.save(tmp_path / "x.pt", payload | {"config": config})
        try:
            start.for_play([f"checkpoint={tmp_path / 'x.pt'}", "device=cpu"], CONFIGS)
        except UserError as error:
            assert str(error).isprintable() and "x.pt" in str(error) and len(str(error)) < 700


@pytest.mark.limits
@pytest.mark.parametrize("kind", ["unpacks to 300 MiB", "cut off", "no archive", "a pipe", "objects"])
def test_archives_of_objects_poses_and_dumps_have_limits(kind, tmp_path, monkeypatch):
    from dexsim import guard
    from dexsim.assets.objects import own
    from dexsim.tasks import nan_dump
    from dexsim.tasks.stable_grasps import GraspSet

    path = tmp_path / "object.npz"
    if kind == "a pipe":
        os.mkfifo(path)
    elif kind == "no archive":
        path.write_text("nothing")
    elif kind == "objects":
        np.savez(path, **{k: np.array([{}], object) for k in ("format", "edge", "config", "hulls")})
    else:
        deflated = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        with deflated as archive, archive.open("edge.npy", "w") as file:
            np.lib.format.write_array(file, np.zeros((1, 300 << 17), np.float64) if kind[0] == "u" else np.zeros(9))
        if kind == "cut off":
            path.write_bytes(path.read_bytes()[:-30])
    begun = time.process_time()
    monkeypatch.setattr(guard, "BYTES", 16 << 20)
    monkeypatch.setattr(guard, "TIMES_SIZE", 1)
    for read in (lambda: own.own_shape(str(tmp_path)), lambda: GraspSet.load(path), lambda: nan_dump.load(path)):
        with pytest.raises(UserError) as error:
            read()
        assert "object.npz" in one_line(error) and (kind[0] != "u" or "of memory" in str(error.value))
    assert time.process_time() - begun < 10
