"""`dexsim convert IN ... out=OUT`: any recording that is read, as MCAP in dexsim's topics or as a LeRobot data set."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim import typed
from dexsim.errors import UserError

if TYPE_CHECKING:
    from dexsim.recording.schema import Recording

USAGE = """usage: dexsim convert IN ... out=OUT [format=mcap|lerobot] [fps=HZ] [units.QUANTITY=UNIT ...]
                      [remap.OURS=THEIRS ...] [meta.KEY=VALUE ...]

Writes recordings in SI units: as MCAP in dexsim's own topics (out=FILE.mcap for one, out=FOLDER for several), or as a
LeRobot v3 data set (format=lerobot, out=FOLDER; fps: of its frames, that of the states by default). IN: a CSV, TSV or
NPZ file with named columns (time, command.JOINT, position.JOINT, effort.JOINT ...), an MCAP file, a bag folder, or a
data set of LeRobot, Zarr or HDF5, whose episodes are recordings (DATASET#3, DATASET#40:). What was assumed is printed.
"""
FPS = (1.0, 1000.0)


def convert(source: Path, out: Path, remap: dict[str, str], meta: dict[str, str]) -> list[str]:
    """Writes `out`, which must not exist; returns what was assumed or lost, in words. Raises UserError."""
    from dexsim.recording.reader import read
    from dexsim.recording.writer import write

    if out.suffix != ".mcap":
        raise UserError(f"out={out}: must end in .mcap")
    _free(out)
    recording = read(source, remap, meta)
    write(out, recording)
    return [f"{f.severity}: {f.text}" for f in recording.findings]


def _free(out: Path) -> None:
    if out.exists():
        raise UserError(f"out={out}: exists; choose another name, or remove it")
    if not out.parent.is_dir():
        raise UserError(f"out={out}: there is no folder {out.parent}")


def to_lerobot(recordings: Sequence[Recording], out: Path, fps: float | None = None) -> None:
    """Write recordings as the episodes of a LeRobot v3 data set in `out`, which must not exist: joint positions as
    `observation.state`, targets in force as `action`, both at `fps` frames a second [Hz] (None: the states' own rate).
    Raises UserError where pyarrow or the commands are missing."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise UserError("format=lerobot needs pyarrow: pip install 'dexsim[lerobot]'") from None
    from dexsim import files

    _free(out)
    joints = recordings[0].joints
    for r in recordings:
        if r.joints != joints:
            raise UserError(f"{r.path}: has other joints than {recordings[0].path}; a data set has one set of joints")
        if len(r.states.position) < 2 or not len(r.commands):
            raise UserError(f"{r.path}: a data set needs states and commands")
        if "position_unit" in r.meta:
            raise UserError(f"{r.path}: {next(f.text for f in r.findings if 'fraction of the travel' in f.text)}")
    rates = [(len(r.states.position) - 1) / float(np.ptp(r.states.position.t)) for r in recordings]
    fps = float(round(float(np.median(rates)))) if fps is None else fps
    columns: dict[str, list[Any]] = {k: [] for k in ("observation.state", "action", "timestamp", "frame_index",
                                                     "episode_index", "index", "task_index")}  # fmt: skip
    episodes: list[dict[str, Any]] = []
    for number, r in enumerate(recordings):
        state, action = (_framed(r, s, fps) for s in (r.states.position, r.targets()))
        first, count = len(columns["index"]), len(state)
        columns["observation.state"] += state.astype(np.float32).tolist()
        columns["action"] += action.astype(np.float32).tolist()
        columns["timestamp"] += (np.arange(count) / fps).astype(np.float32).tolist()
        columns["frame_index"] += range(count)
        columns["episode_index"] += [number] * count
        columns["index"] += range(first, first + count)
        columns["task_index"] += [0] * count
        episodes.append({"episode_index": number, "tasks": [TASK], "length": count, "data/chunk_index": 0,
                         "data/file_index": 0, "dataset_from_index": first, "dataset_to_index": first + count,
                         "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})  # fmt: skip
    vector = {"dtype": "float32", "shape": [len(joints)], "names": [f"{j}.pos" for j in joints]}
    scalar = {name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
              for name in list(columns)[2:]}  # fmt: skip
    info = {
        "codebase_version": "v3.0", "robot_type": recordings[0].meta["robot"], "total_episodes": len(episodes),
        "total_frames": len(columns["index"]), "total_tasks": 1, "chunks_size": 1000, "fps": int(fps) if fps == int(fps)
        else fps, "splits": {"train": f"0:{len(episodes)}"}, "data_files_size_in_mb": 100,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None,
        "features": {"observation.state": vector, "action": vector} | scalar,
    }  # fmt: skip
    stats = {}
    for name, values in columns.items():
        x = np.asarray(values, float).reshape(len(values), -1)
        stats[name] = {"min": x.min(0).tolist(), "max": x.max(0).tolist(), "mean": x.mean(0).tolist(),
                       "std": x.std(0).tolist(), "count": [len(x)]}  # fmt: skip
    size = pa.list_(pa.float32(), len(joints))
    types = {"observation.state": size, "action": size, "timestamp": pa.float32()}
    data = pa.table({k: pa.array(v, types.get(k, pa.int64())) for k, v in columns.items()})
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
    with files.beside(out) as part:
        for folder in ("data/chunk-000", "meta/episodes/chunk-000"):
            (part / folder).mkdir(parents=True)
        parquet.write_table(data, part / "data/chunk-000/file-000.parquet")
        parquet.write_table(pa.Table.from_pylist(episodes), part / "meta/episodes/chunk-000/file-000.parquet")
        parquet.write_table(tasks, part / "meta/tasks.parquet")
        (part / "meta/info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")
        (part / "meta/stats.json").write_text(json.dumps(stats, indent=4), encoding="utf-8")


TASK = "joint motion"


def _framed(r: Recording, s: Any, fps: float) -> np.ndarray:
    """Return [n, J] values of a series at the frames from the first state on: what was read, or the target in force."""
    start, end = float(r.states.position.t[0]), float(r.states.position.t[-1])
    t = start + np.arange(int((end - start) * fps + 1e-6) + 1) / fps
    return s.at(t + 1e-9, held=True) if s.topic == r.commands.topic else s.at(t)


def main(argv: Sequence[str]) -> int:
    """Returns the exit status. Raises UserError."""
    from dexsim.recording import readers
    from dexsim.recording.arguments import read_arguments
    from dexsim.recording.reader import read

    taken = [a for a in argv if a.startswith(("out=", "format=", "fps="))]
    own = typed.settings(taken, ("out", "format", "fps"))
    if not own.get("out"):
        raise UserError("say where to: out=FILE.mcap, or out=FOLDER")
    kind = typed.one_of("format", own.get("format", "mcap"), ("mcap", "lerobot"))
    fps = typed.number("fps", own["fps"], *FPS) if "fps" in own else None
    given, remap, meta = read_arguments([a for a in argv if a not in taken])
    paths = [q for p in given for q in readers.expanded(Path(p).expanduser())]
    out = Path(own["out"]).expanduser()
    if kind == "lerobot":
        to_lerobot([read(p, remap, meta, audit=False) for p in paths], out, fps)
        print(f"{out}: {len(paths)} episodes")
        return 0
    if len(paths) > 1 and out.suffix == ".mcap":
        raise UserError(f"out={out}: {len(paths)} recordings go into a folder: out={out.with_suffix('')}")
    several = len(paths) > 1
    if several:
        _free(out)
        out.mkdir()
    for path in paths:
        to = out / f"{path.name.replace('#', '_')}.mcap" if several else out
        for line in convert(path, to, remap, meta):
            print(line)
        print(to)
    return 0
