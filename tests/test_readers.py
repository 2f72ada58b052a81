"""Data sets of LeRobot, Zarr, HDF5 and PACE, as the libraries that labs use write them, read as recordings."""

from __future__ import annotations

import json
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

from dexsim.errors import UserError
from dexsim.gap.read import inputs
from dexsim.recording import convert, read, readers

JOINTS, FPS, LENGTHS = ("shoulder", "elbow"), 50, (100, 150, 120)


def motion(episode):
    """Return (t [n], targets [n, J], positions [n, J]) of an episode."""
    t = np.arange(LENGTHS[episode]) / FPS
    c = np.stack([0.4 * np.sin(2 * t + k + episode) for k in range(2)], 1)
    return t, c, np.stack([0.4 * np.sin(2 * (t - 0.04) + k + episode) for k in range(2)], 1)


def lerobot(folder, version):
    """Write a data set in the documented layout of v2.1 (a file an episode) or v3.0 (episodes in one file)."""
    pa = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    names = [f"{j}.pos" for j in JOINTS] if version == "v3.0" else {"motors": list(JOINTS)}
    vector = {"dtype": "float32", "shape": [2], "names": names}
    path = "episode_{episode_index:06d}" if version == "v2.1" else "file-{file_index:03d}"
    chunk = "{episode_chunk:03d}" if version == "v2.1" else "{chunk_index:03d}"
    info = {"codebase_version": version, "fps": FPS, "robot_type": "so100", "total_episodes": 3, "chunks_size": 1000,
            "data_path": f"data/chunk-{chunk}/{path}.parquet",
            "features": {"observation.state": vector, "action": vector}}  # fmt: skip
    (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables, at = [], 0
    for k in range(3):
        t, c, q = motion(k)
        tables.append(pa.table({
            "observation.state": pa.array(q.astype(np.float32).tolist(), pa.list_(pa.float32(), 2)),
            "action": pa.array(c.astype(np.float32).tolist(), pa.list_(pa.float32(), 2)),
            "timestamp": t.astype(np.float32), "frame_index": np.arange(len(t)),
            "episode_index": np.full(len(t), k), "index": at + np.arange(len(t)), "task_index": np.zeros(len(t), int),
        }))  # fmt: skip
        at += len(t)
        if version == "v2.1":
            parquet.write_table(tables[-1], folder / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
    if version == "v3.0":
        parquet.write_table(pa.concat_tables(tables), folder / "data" / "chunk-000" / "file-000.parquet")
        rows = [{"episode_index": k, "data/chunk_index": 0, "data/file_index": 0} for k in range(3)]
        parquet.write_table(pa.Table.from_pylist(rows), folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    return folder


def replay_buffer(folder, version):
    """Write Zarr as diffusion-policy code writes it: arrays of all episodes, and their ends."""
    zarr = pytest.importorskip("zarr")
    root = zarr.open_group(str(folder), mode="w", zarr_format=version)
    data, meta = root.create_group("data"), root.create_group("meta")
    every = [motion(k) for k in range(3)]
    for name, k in (("timestamp", 0), ("action", 1), ("state", 2)):
        data.create_array(name, data=np.concatenate([m[k] for m in every]))
    meta.create_array("episode_ends", data=np.cumsum(LENGTHS))
    root.attrs["joint_names"] = list(JOINTS)
    return folder


def hands(folder, version):
    """Write Zarr with a group an episode, joints and touch of a right hand."""
    zarr = pytest.importorskip("zarr")
    root = zarr.open_group(str(folder), mode="w", zarr_format=version)
    for k in range(3):
        t, c, q = motion(k)
        group = root.create_group(f"episode_{k}")
        group.attrs["joint_names"] = list(JOINTS)
        touch = np.zeros((len(t), 5, 12, 3)) + t[:, None, None, None]
        parts = {"timestamps": t, "right_hand_joints": q, "right_hand_joints_command": c, "right_tactile_data": touch}
        for name, x in parts.items():
            group.create_array(name, data=x)
    return folder


def robomimic(path, version):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": FPS}})
        for k in range(3):
            _, c, q = motion(k)
            demo = data.create_group(f"demo_{k}")
            demo.create_dataset("actions", data=c)
            demo.create_dataset("obs/robot0_joint_pos", data=q)
            demo.create_dataset("obs/agentview_image", data=np.zeros((len(q), 4, 4, 3), np.uint8))
    return path


def named(r, version=None):
    return dict(zip(r.joints, r.states.position.value.T, strict=True))


SETS = [
    ("set", lerobot, "v2.1"), ("set", lerobot, "v3.0"), ("set.zarr", replay_buffer, 2), ("set.zarr", replay_buffer, 3),
    ("set.zarr", hands, 2), ("set.zarr", hands, 3), ("set.hdf5", robomimic, 0),
]  # fmt: skip


@pytest.mark.parametrize(("name", "make", "version"), SETS)
def test_episodes_of_a_data_set_are_recordings(tmp_path, name, make, version):
    made = make(tmp_path / name, version)
    paths = inputs.files([made], "recordings")
    assert [p.name for p in paths] == [f"{name}#{k}" for k in range(3)]
    for k in (0, 2):
        r, (t, c, q) = read(paths[k]), motion(k)
        assert len(r.joints) == 2 and len(r.states.position) == len(t)
        assert np.allclose(r.states.position.t, t, atol=1e-6) and np.allclose(r.states.position.value, q, atol=1e-6)
        assert np.allclose(r.commands.value, c, atol=1e-6)
        if make is not robomimic:
            assert r.joints == JOINTS
        if make is hands:
            assert r.tactile.value.shape == (len(t), 5, 12, 3) and np.allclose(r.tactile.value[:, 0, 0, 0], t)
        if make in (lerobot, robomimic):
            assert any("nominal" in f.text for f in r.findings)
    with pytest.raises(UserError, match=r"holds 3 episodes; say which"):
        read(made)
    with pytest.raises(UserError, match=r"'7' is none of its 3 episodes, 0 to 2"):
        read(made.with_name(made.name + "#7"))


GOLDEN = Path(__file__).parent / "golden" / "lerobot"


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_what_the_lerobot_package_wrote(version):
    """Data sets that lerobot 0.3.3 and 0.4.3 wrote (`golden/lerobot/write.py`), within the limits of a reader's
    process."""
    pytest.importorskip("pyarrow")
    sys.path.insert(0, str(GOLDEN))
    try:
        import write
    finally:
        sys.path.pop(0)
    paths = inputs.files([GOLDEN / version], "recordings")
    assert len(paths) == 3
    for k, path in enumerate(paths):
        r, (c, q) = read(path), write.motion(k)
        assert r.joints == ("shoulder_pan", "elbow_flex") and r.meta["robot"] == "so100_follower"
        assert np.allclose(r.commands.value, c, atol=1e-6) and np.allclose(r.states.position.value, q, atol=1e-6)
        assert np.allclose(r.states.position.t, np.arange(len(q)) / write.FPS, atol=1e-6)


def test_aloha_has_an_episode_a_file_and_its_rate_is_stated(tmp_path):
    h5py = pytest.importorskip("h5py")
    _, c, q = motion(0)
    with h5py.File(tmp_path / "episode_0.hdf5", "w") as file:
        file.attrs["sim"] = False
        file.create_dataset("action", data=c)
        file.create_dataset("observations/qpos", data=q)
        file.create_dataset("observations/qvel", data=np.gradient(q, axis=0) * FPS)
        file.create_dataset("observations/effort", data=q)
        file.create_dataset("observations/images/cam_high", data=np.zeros((len(q), 2, 2, 3), np.uint8))
    with pytest.raises(UserError, match=r"no column of time.* or meta.rate=HZ"):
        read(tmp_path / "episode_0.hdf5")
    r = read(tmp_path / "episode_0.hdf5", meta={"rate": FPS, "joint_names": "shoulder,elbow"})
    assert np.allclose(r.commands.value, c) and np.allclose(r.states.position.value, q)
    assert r.states.effort is not None and r.states.velocity is not None


def test_what_pace_writes(tmp_path):
    import torch

    t, c, q = (torch.tensor(x) for x in motion(0))
    torch.save({"time": t, "des_dof_pos": c, "dof_pos": q}, tmp_path / "chirp.pt")
    np.savez(tmp_path / "chirp.npz", time_s=t, des_dof_pos=c, dof_pos=q, joints=np.array(JOINTS))
    for name in ("chirp.pt", "chirp.npz"):
        r = read(tmp_path / name)
        assert np.allclose(r.commands.value, c) and np.allclose(r.states.position.value, q) and len(r.joints) == 2
    torch.save({"time": t, "robot": readers.Torch()}, tmp_path / "more.pt")
    with pytest.raises(UserError, match="more than plain tensors"):
        read(tmp_path / "more.pt")


def test_a_pickle_is_refused_unopened(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "boom"), "w"))

    (tmp_path / "log.pkl").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(UserError, match="a pickle runs what it holds .* np.savez"):
        read(tmp_path / "log.pkl")
    assert not (tmp_path / "boom").exists()


def test_an_action_that_is_no_joint_target_is_left_out(tmp_path):
    h5py = pytest.importorskip("h5py")
    _, c, q = motion(0)
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.attrs["fps"] = FPS
        file.create_dataset("action", data=np.c_[c, c, c])
        file.create_dataset("observations/qpos", data=q)
    r = read(tmp_path / "a.hdf5")
    assert not len(r.commands) and any("not joint targets" in f.text for f in r.findings)


OUTSIDE = b'{"total_episodes": 1, "data_path": "../../{episode_index}", "fps": 1}'


@pytest.mark.parametrize("content", [b"", b"{", OUTSIDE])
def test_a_damaged_data_set_is_one_line(tmp_path, content):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_bytes(content)
    with pytest.raises(UserError) as error:
        read(tmp_path)
    assert "\n" not in str(error.value) and str(tmp_path) in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "make", "version"), [SETS[0], SETS[5], SETS[6]])
def test_a_data_set_goes_to_mcap_and_back(tmp_path, name, make, version):
    """Any data set to MCAP, that to LeRobot: each as it was."""
    made = make(tmp_path / name, version)
    assert convert.main([str(made), f"out={tmp_path / 'mcap'}"]) == 0
    files = sorted((tmp_path / "mcap").iterdir())
    assert [p.name for p in files] == [f"{name}_{k}.mcap" for k in range(3)]
    assert convert.main([*map(str, files), f"out={tmp_path / 'back'}", "format=lerobot"]) == 0
    for k, path in enumerate(inputs.files([tmp_path / "back"], "recordings")):
        first, (t, c, q) = read(files[k]), motion(k)
        for r, atol in ((first, 1e-6), (read(path), 1e-5)):  # LeRobot has float32
            assert len(r.joints) == 2 and np.allclose(r.states.position.t, t, atol=1e-6)
            assert np.allclose(r.states.position.value, q, atol=atol) and np.allclose(r.commands.value, c, atol=atol)
            assert r.joints == first.joints
        if make is hands:
            assert np.allclose(first.tactile.value[:, 0, 0, 0], t, atol=1e-6)
    info = json.loads((tmp_path / "back" / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["total_frames"] == sum(LENGTHS) and info["fps"] == FPS
    with pytest.raises(UserError, match="exists"):
        convert.main([str(files[0]), f"out={tmp_path / 'back'}", "format=lerobot"])


def test_what_is_held_out_is_taken_out_of_the_fit(tmp_path):
    for k in range(4):
        (tmp_path / f"run_{k}.csv").write_text("time,position.a\n0,1\n")
    (tmp_path / "run_0.csv.yaml").write_text("gravity: 0 0 0\n")
    fitted, held = inputs.parted(f"{tmp_path}/run_*.csv", f"{tmp_path}/run_3.csv")
    assert [p.name for p in fitted] == [f"run_{k}.csv" for k in range(3)] and [p.name for p in held] == ["run_3.csv"]
    fitted, held = inputs.parted(f"{tmp_path.with_name(tmp_path.name[:-1])}?/run_[0-2].csv", f"{tmp_path}/run_[12].csv")
    assert [p.name for p in fitted] == ["run_0.csv"] and [p.name for p in held] == ["run_1.csv", "run_2.csv"]
    fitted, held = inputs.parted(f"{tmp_path}/run_*.csv", "episodes[2:]")
    assert len(fitted) == 2 and [p.name for p in held] == ["run_2.csv", "run_3.csv"]
    with pytest.raises(UserError, match="nothing is left to fit"):
        inputs.parted(f"{tmp_path}/run_*.csv", f"{tmp_path}/*.csv")
    with pytest.raises(UserError, match=r"held_out=episodes\[9:\]: '9:' is none"):
        inputs.parted(f"{tmp_path}/run_*.csv", "episodes[9:]")


def test_another_package_adds_a_reader(monkeypatch, tmp_path):
    class Plain:
        needs, imports = "nothing", ()

        def fits(self, path):
            return path.suffix == ".plain"

        def count(self, path):
            return 2

        def read(self, path, episode):
            t = np.arange(50) / 50
            return readers.Episode({"time": t, "position.a": t + episode, "command.a": t})

    class Point:
        value = "plain:Plain"

    brought = {"dexsim.readers": {"plain": Point()}}
    monkeypatch.setattr(readers.door, "installed", lambda group: brought[group])
    monkeypatch.setattr(readers.door, "load", lambda where, about: Plain)
    readers.known.cache_clear()
    try:
        (tmp_path / "x.plain").write_text("")
        assert read(tmp_path / "x.plain#1").states.position.value[0, 0] == 1.0
    finally:
        readers.known.cache_clear()
