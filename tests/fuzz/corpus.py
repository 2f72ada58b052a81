"""Sound files of each kind, from which damaged ones are made."""

from __future__ import annotations

import contextlib
import io
import json
import os
from pathlib import Path

import numpy as np
import trimesh
import yaml
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from dexsim import export
from dexsim.assets.objects import own
from dexsim.learning import checkpoint
from dexsim.recording import Recording, Series, States, schema, write
from tools.assets import xhand

ROOT = Path(__file__).parents[2]
JOINTS = ("a", "b")
SERVO = {
    "drive": "torque",
    "control_rate": 100,
    "loop_encoder": {"a": "motor"},
    "current_per_torque": {"a": 0.9, "b": "unknown"},
    "supply_voltage": 24.0,
    "joints": {
        "*": {"kp": 1.5, "kd": [0.01, 0.03], "torque_limit": 2.0},
        "a": {"kp": {"value": 1.0, "low": 0.9, "high": 1.1}, "delay": "unknown"},
    },
}
CALIBRATION = {
    "schema": 1,
    "normalization": "matched",
    "current_sign": {"index_joint1": 1, "mid_joint1": -1},
    "joints": {
        "index_joint1": {
            "current_per_torque": {"value": 2.7, "low": 2.5, "high": 2.9, "r2": 0.99},
            "current_max": 1.2,
            "torque_max": 1.1,
        }
    },
    "touch": {
        "lsb": 0.1,
        "axis_sign": [-1, -1, 1],
        "threshold": {"value": 0.1},
        "gain": {"thumb": [1.0] * 120},
        "bias": {"mid": [0.0] * 120},
        "dead": {"thumb": [3, 4]},
        "swapped": {"mid": [[1, 2], [5, 6]]},
    },
}
TACTILE = {
    "tactile": {
        "friction": [0.35, 0.45],
        "pads": {
            "index": {
                "gain": {"value": 0.6, "low": 0.57, "high": 0.63},
                "taxels": {17: [0.4, 0.5]},
                "dead": [3],
                "stuck": {33: 0.4},
                "swapped": [[14, 15]],
                "crosstalk": [0.2, 0.3],
                "delay": [0.018, 0.022],
                "rubber": {"c10": [9e4, 1.1e5], "c01": 2e4},
            }
        },
    },
    "randomize": {"object.friction": [0.35, 0.45], "contact.stiffness": {"value": 4500, "low": 4300, "high": 4700}},
}
METADATA = {
    "gravity": "0 0 -9.81",
    "effort_is": "torque_Nm",
    "effort_sign": "+1,-1",
    "robot": "rig",
    "position_unit": "rad",
    "tactile_lsb": "0.1",
    "servo": SERVO,
    "joint_names": ["a", "b"],
    "tactile_axis_sign": "1 1 1",
}
CONFIG = {
    "sim": {"timestep": 0.002, "iterations": 10},
    "task": {"contact": {"impedance": 0.9}},
    "recorded_world": {
        "index": 0,
        "object": {
            "kind": "box",
            "shape": "cube",
            "size": [0.02, 0.02, 0.02],
            "mass": 0.1,
            "friction": 0.5,
            "stiffness": 4000.0,
            "damping_ratio": 0.3,
        },
    },
}
OVERRIDES = (
    "task=grasp",
    "device=cpu",
    "worlds=4",
    "task.rewards.force_near=2.0",
    "task.objects.train=[box,sphere]",
    "randomize.object.mass=[0.05,0.2]",
    "sim.timestep=0.007",
    "agent.actor.hidden_dims=[16,16]",
    "agent.algorithm.learning_rate=1e-3",
    "servo=ideal",
    "tactile.delay=[0.0,0.02]",
    "task.reward.reach_length=0.05",
    "randomize.contact.stiffness={log: [4000,9000]}",
    "task.critic=paper",
    "save_worlds=true",
)
HAND = yaml.safe_load((xhand.FOLDER / "hand.yaml").read_text(encoding="utf-8"))
HAND |= {key: Path(HAND[key]).name for key in ("servo", "held_cubes")}  # all in one folder
TREES = {
    "servo": SERVO, "calibration": CALIBRATION, "tactile": TACTILE, "metadata": METADATA, "config": CONFIG, "hand": HAND
}  # fmt: skip


def recording(seconds: float = 1.5, tactile: bool = True, config: str | None = None) -> Recording:
    """Return two joints at 100 Hz, touch and an object now and then."""
    t = np.arange(0, seconds, 0.01)
    q = np.stack([0.3 * np.sin(3 * t), 0.2 * np.cos(2 * t)], 1)
    meta = schema.DEFAULTS | {
        "effort_is": "torque_Nm",
        "joint_names": "a,b",
        "tactile_lsb": "0.1",
        "servo": yaml.safe_dump(SERVO),
    }
    out = Recording(
        Path("made"),
        meta,
        JOINTS,
        Series(t, q, schema.COMMANDS),
        States(*(Series(t, x, schema.STATES) for x in (np.roll(q, 3, 0), q, q))),
        start_ns=1_700_000_000_000_000_000,
        config=config,
    )
    out.temperature = Series(t[::10], np.full((len(t[::10]), 2), 30.0), schema.TEMPERATURES)
    out.enabled = Series(t[::50], np.ones((len(t[::50]), 2)), schema.ENABLED)
    out.supply_voltage = Series(t[::10], np.full(len(t[::10]), 24.0), schema.SUPPLY)
    if tactile:
        out.tactile = Series(t[::30], np.ones((len(t[::30]), 5, 120, 3)), schema.TACTILE)
        out.object_pose = Series(t[::10], np.tile([0, 0, 0.1, 1.0, 0, 0, 0], (len(t[::10]), 1)), schema.OBJECT_POSE)
        out.external_force = Series(t[::10], np.ones((len(t[::10]), 6)), schema.EXTERNAL_FORCE)
        out.imu = Series(t[::10], np.ones((len(t[::10]), 10)), schema.IMU)
    return out


def build(folder: Path) -> dict[str, list[Path]]:
    """Sound files by kind, written into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "full.mcap", recording(config=yaml.safe_dump(CONFIG)))
    write(folder / "small.mcap", recording(0.5, tactile=False))
    foreign(folder / "lz4.mcap", CompressionType.LZ4, "cdr")
    foreign(folder / "json.mcap", CompressionType.NONE, "json")
    r = recording(0.5, tactile=False)
    t, q = r.commands.t, r.commands.value
    rows = "".join(
        f"{x:.3f},{a:.6f},{b:.6f},{c:.6f},{d:.6f}\n"
        for x, (a, b), (c, d) in zip(t, q, r.states.position.value, strict=True)
    )
    (folder / "plain.csv").write_text("time,command.a,command.b,position.a,position.b\n" + rows)
    np.savez(folder / "plain.npz", time=t, command=q, position=r.states.position.value, joint_names=list(JOINTS))
    np.savez_compressed(
        folder / "packed.npz", **{"time_ms": 1e3 * t, "position.a": q[:, 0], "command.a [deg]": q[:, 1]}
    )
    for kind, tree in TREES.items():
        (folder / f"{kind}.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    files = sorted(folder.iterdir())
    out = {"recording": [p for p in files if p.suffix in (".mcap", ".csv", ".npz") and p.name != "object.npz"]}
    checkpoint.save(folder / "checkpoint.pt", checkpoint_payload())
    if not (folder / "bundle").exists():
        with contextlib.redirect_stdout(io.StringIO()):
            export.export(str(ROOT / "checkpoints" / "grasp.pt"), folder / "bundle", steps=2)
    (folder / "overrides.txt").write_text("\n".join(OVERRIDES))
    out |= {
        "object": objects(folder),
        "network": [folder / "bundle" / "policy.onnx"],
        "checkpoint": [folder / "checkpoint.pt"],
        "manifest": [folder / "bundle" / "manifest.yaml"],
        "overrides": [folder / "overrides.txt"],
    }
    with contextlib.suppress(ImportError):  # without pyarrow, h5py or zarr
        out["dataset"] = data_sets(folder / "sets")
    return out | {kind: [folder / f"{kind}.yaml"] for kind in TREES}


def data_sets(folder: Path) -> list[Path]:
    """Return a bag of SQLite, an HDF5 file, a Zarr archive, a LeRobot folder and a dictionary of tensors."""
    import h5py
    import torch
    import zarr
    from pyarrow import parquet, table
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as BagWriter
    from rosbags.typesys import Stores, get_typestore

    from dexsim.recording import cdr

    folder.mkdir(exist_ok=True)
    t = np.arange(0, 1, 0.02)
    x = np.stack([0.3 * np.sin(3 * t), 0.2 * np.cos(2 * t)], 1)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with BagWriter(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics = [bag.add_connection(n, schema.JOINT_STATE, typestore=store) for n in (schema.STATES, schema.COMMANDS)]
        for i, q in enumerate(x):
            ns = 10**18 + i * 20_000_000
            for topic in topics:
                bag.write(topic, ns, cdr.joint_state(ns, JOINTS, q, None, q))
    (folder / "bag" / "bag.db3").rename(folder / "bag.db3")
    with h5py.File(folder / "aloha.h5", "w") as file:
        file.attrs["fps"] = 50
        for name in ("observations/qpos", "action"):
            file.create_dataset(name, data=x, chunks=(10, 2), compression="gzip")
    with zarr.storage.ZipStore(folder / "rig.zarr.zip", mode="w") as zipped:
        group = zarr.create_group(zipped, attributes={"fps": 50, "joint_names": list(JOINTS)})
        for name in ("state", "action"):
            group.create_array(name, data=x, chunks=(10, 2))
    torch.save({"time": torch.tensor(t)} | {k: torch.tensor(x) for k in ("dof_pos", "des_dof_pos")}, folder / "pace.pt")
    parts = folder / "lerobot" / "data" / "chunk-000", folder / "lerobot" / "meta"
    for part in parts:
        part.mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [2], "names": list(JOINTS)}
    (parts[1] / "info.json").write_text(json.dumps({
        "codebase_version": "v2.1", "total_episodes": 1, "fps": 50, "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "features": {"observation.state": feature, "action": feature},
    }))  # fmt: skip
    rows = {"observation.state": x.tolist(), "action": x.tolist(), "timestamp": t, "frame_index": range(len(t))}
    parquet.write_table(table(rows | {"episode_index": [0] * len(t)}), parts[0] / "episode_000000.parquet")
    return sorted(p for p in folder.iterdir() if p.name != "bag")


def objects(folder: Path) -> list[Path]:
    """Return a box as meshes and as an imported object."""
    box, made = trimesh.creation.box((0.04, 0.05, 0.06)), []
    for end in ("obj", "stl", "ply"):
        made.append(folder / f"mesh.{end}")
        box.export(made[-1])
    os.environ.setdefault("DEXSIM_CACHE", str(folder / "cache"))
    own.save(own.own_shape(str(made[0]), parts=1), folder / "object.npz")
    return [*made, folder / "object.npz"]


def foreign(path: Path, compression: CompressionType, encoding: str) -> None:
    """Write a bag as others write it: other topics, no metadata."""
    from dexsim.recording import cdr

    with open(path, "wb") as file:
        w = McapWriter(file, compression=compression, chunk_size=4096)
        w.start("ros2" if encoding == "cdr" else "", "other")
        if encoding == "cdr":
            kind = w.register_schema(schema.JOINT_STATE, "ros2msg", cdr.definition(schema.JOINT_STATE).encode())
        else:
            kind = w.register_schema("JointState", "jsonschema", b"{}")
        channels = [w.register_channel(topic, encoding, kind) for topic in ("/arm/joint_states", "/arm/joint_commands")]
        for i in range(40):
            ns = 1_700_000_000_000_000_000 + i * 10_000_000
            x = np.array([0.01 * i, -0.01 * i])
            for channel in channels:
                if encoding == "cdr":
                    data = cdr.joint_state(ns, JOINTS, x, None, x)
                else:
                    data = json.dumps(
                        {
                            "name": JOINTS,
                            "position": x.tolist(),
                            "effort": x.tolist(),
                            "header": {"stamp": {"sec": 1, "nanosec": i}},
                        }
                    ).encode()
                w.add_message(channel, log_time=ns, data=data, publish_time=ns)
        w.finish()


def checkpoint_payload() -> dict:
    """Return a whole training's checkpoint, its networks and worlds tiny."""
    import torch

    from dexsim.cli import start
    from dexsim.paths import CONFIGS

    cfg = start.for_train(["task=grasp", "device=cpu", "worlds=2", "iterations=3"], CONFIGS).cfg
    weights = {
        "mlp.0.weight": torch.ones(2, 3),
        "obs_normalizer._mean": torch.zeros(1, 3),
        "obs_normalizer.count": torch.tensor(5),
    }
    return {
        "kind": "train",
        "config": cfg,
        "versions": {"dexsim": "0.1.0"},
        "git": {"commit": "unknown", "dirty": False},
        "layout": {
            "joints": ["a", "b"],
            "action": [["a", -1.0, 1.0, "rad"]],
            "observations": {"actor": [["x", 3]], "critic": [["x", 3]]},
        },
        "iteration": 3,
        "steps": 144,
        "actor": weights,
        "critic": dict(weights),
        "optimizer": {
            "state": {0: {"step": torch.tensor(3.0), "exp_avg": torch.zeros(2, 3)}},
            "param_groups": [{"lr": 1e-3, "params": [0]}],
        },
        "env": {"rng": torch.zeros(16, dtype=torch.uint8), "nan_count": torch.tensor(0)},
        "rng": checkpoint.rng_state(),
        "worlds": {"env.q": torch.zeros(2, 12), "rng": torch.zeros(16, dtype=torch.uint8)},
    }
