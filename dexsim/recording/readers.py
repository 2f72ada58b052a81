"""Data sets that labs have, as recordings: one small reader each, behind the door `dexsim.readers`.

A reader says which paths are its own, which episodes they hold, and gives the columns of one (`Episode`), named as
those of a CSV file (`recording/columns.py`). `PATH#3` is the fourth episode of a data set, `PATH#40:` are those from 40
on. A package of others adds a reader by an entry point of the group `dexsim.readers` that leads to such a class.

=========  =============================================================================================================
lerobot    LeRobot v2.1 and v3: a folder with `meta/info.json`; `observation.state`, `action`, names and fps
zarr       Zarr v2 and v3: one group an episode, or `data/` beside `meta/episode_ends`
hdf5       ALOHA (`observations/qpos`, `action`) and robomimic (`data/demo_N/obs`, `actions`)
torch      a `.pt` of plain tensors by name, as PACE writes (`time`, `dof_pos`, `des_dof_pos`)
=========  =============================================================================================================
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from dexsim import door, files, guard
from dexsim.errors import UserError
from dexsim.recording.schema import TACTILE, Finding, brief, note

GROUP = "dexsim.readers"
MAX_EPISODES = 100_000
PICKLES = (".pkl", ".pickle", ".joblib", ".npy")
NOMINAL = "times are nominal, frame / rate: what a reading or a command was late by is not in them"


@dataclass
class Episode:
    """One episode: columns [T] by name (`position.elbow`, `command.elbow`, `time` ...), what is known of it (`meta`),
    arrays [T, ...] of other topics, and what was assumed."""

    columns: dict[str, np.ndarray]
    meta: dict[str, str] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


class Reader(Protocol):
    """What reads one kind of data set. imports: the modules that it needs; needs: as `pip install` takes them."""

    needs: ClassVar[str]
    imports: ClassVar[tuple[str, ...]]

    def fits(self, path: Path) -> bool:
        """Return whether the path is such a data set; looks at names only."""

    def count(self, path: Path) -> int:
        """Return how many episodes it holds."""

    def read(self, path: Path, episode: int) -> Episode:
        """Return one of them. Raises UserError, KeyError, ValueError or OSError for what is not as it should be."""


@cache
def known() -> dict[str, Reader]:
    """Return all readers by name: those of dexsim, and what other packages add."""
    out: dict[str, Reader] = {"lerobot": LeRobot(), "zarr": Zarr(), "hdf5": Hdf5(), "torch": Torch()}
    for name, point in door.installed(GROUP).items():
        if name not in out:
            out[name] = door.load(point.value, f"reader {name} (entry point of {GROUP})")()
    return out


def address(path: Path) -> tuple[Path, str]:
    """Return (the file or folder, what follows `#`: its episodes, or nothing)."""
    if "#" not in path.name or path.exists():
        return path, ""
    name, _, part = path.name.rpartition("#")
    return path.with_name(name), part


def reader_of(path: Path) -> Reader | None:
    """Return what reads a path; None where it is no data set. Raises UserError for a pickle, which runs code when
    opened."""
    if path.suffix.lower() in PICKLES:
        raise UserError(
            f"recording {path}: a pickle runs what it holds when it is opened, and is not read; save plain arrays where"
            " it was made: np.savez('a.npz', time=..., command=..., position=..., joint_names=[...])"
        )
    return next((r for r in known().values() if r.fits(path)), None)


def ready(reader: Reader, path: Path) -> int:
    """Import what a reader needs, once for all of its files; the bytes of a data set's own numbers, without the films
    beside them. Raises UserError where a package is missing."""
    for name in reader.imports:
        try:
            import_module(name)
        except ImportError:
            raise UserError(f"recording {path}: needs {name}: pip install {reader.needs}") from None
    inside = [path] if path.is_file() else (p for p in path.rglob("*") if p.is_file() and "videos" not in p.parts)
    return sum(files.check(p, "recording", 64 << 30) for p in inside)


def expanded(path: Path) -> list[Path]:
    """Return the recordings that a path stands for: the episodes of a data set, those that follow `#`, or itself."""
    base, part = address(path)
    if not base.exists():
        return [path]
    reader = reader_of(base)
    if reader is None:
        if part:
            raise UserError(f"recording {path}: {base.name} has no episodes")
        return [path]
    count = guard.call(_count, base, what=f"recording {base}", size=ready(reader, base))
    if not count or count > MAX_EPISODES:
        raise UserError(f"recording {base}: it holds {count} episodes; 1 to {MAX_EPISODES} are read")
    chosen = numbers(part, count, f"recording {path}") if part else range(count)
    return [base.with_name(f"{base.name}#{k}") for k in chosen] if count > 1 or part else [base]


def _count(path: Path) -> int:
    reader = reader_of(path)
    assert reader is not None  # `expanded` has looked
    return int(reader.count(path))


def numbers(text: str, count: int, where: str) -> list[int]:
    """Return the numbers below count that `3`, `40:`, `:40` or `1:9:2` stand for. Raises UserError, which `where`
    begins."""
    if not re.fullmatch(r"-?\d+|(-?\d+)?:(-?\d+)?(:\d+)?", text):
        raise UserError(f"{where}: '{text}' must be a number or a slice, such as 3, 40: or :40")
    parts = [int(x) if x else None for x in text.split(":")]
    if len(parts) == 1:
        found = [k % count for k in parts if k is not None and -count <= k < count]
    else:
        found = list(range(count))[slice(*parts)]
    if not found:
        raise UserError(f"{where}: '{text}' is none of its {count} episodes, 0 to {count - 1}")
    return found


def read_episode(path: Path, reader: Reader, part: str) -> Episode:
    """Return the episode that `path#part` names; the only one where nothing is named. Raises UserError."""
    count = reader.count(path)
    if not part and count > 1:
        raise UserError(f"recording {path}: holds {count} episodes; say which: {path.name}#0 to #{count - 1}")
    (episode, *rest) = numbers(part or "0", count, f"recording {path}")
    if rest:
        raise UserError(f"recording {path}#{part}: names {len(rest) + 1} episodes; one is read at a time")
    return reader.read(path, episode)


# -- arrays by name ---------------------------------------------------------------------------------------------------

_KINDS = (
    ("time", r"(^|_)(timestamps?|time|t)$"),
    ("", r"image|rgb|depth|eef|(^|_)ee_|pose|quat|wrench|object|reward|done|contact"),
    ("tactile", r"tactile|taxel"),
    ("command", r"(^|_)actions?($|_)|command|cmd|target|goal|desired|(^|_)des_|ctrl"),
    ("velocity", r"vel|(^|_)dq"),
    ("effort", r"effort|torque|(^|_)tau|current"),
    ("position", r"joint|qpos|state|position|(^|_)pos($|_)|proprio|angle|(^|_)q$"),
)  # fmt: skip
_WORDS = re.compile(
    r"timestamps?|time|actions?|commands?|cmd|targets?|goal|desired|des|ctrl|velocit(y|ies)|vel|qvel|efforts?|torques?|"
    r"tau|current|joints?|qpos|states?|positions?|pos|proprio|angles?|dof|data|observation|robot0"
)


def quantity_of(name: str) -> tuple[str, str]:
    """Return (quantity of an array by its name, or nothing; what of the name is not the quantity's)."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    kind = next((k for k, pattern in _KINDS if re.search(pattern, plain)), "")
    return kind, "_".join(w for w in plain.split("_") if w and not _WORDS.fullmatch(w))


def of_arrays(arrays: Mapping[str, np.ndarray], names: Mapping[str, Sequence[str]], rate: float | None) -> Episode:
    """Return an episode from arrays [T] or [T, J] by name, joints named by `names` of an array, or numbered; rate [Hz]
    where no array is a time."""
    out = Episode({})
    groups: dict[str, list[tuple[str, str, np.ndarray]]] = {}
    for name, x in arrays.items():
        kind, stem = quantity_of(name)
        x = np.asarray(x)
        if kind and x.dtype.kind in "fiub" and x.ndim and len(x):
            groups.setdefault(kind, []).append((name, stem, x))
    for name, _, x in groups.pop("time", []):
        word = re.sub(r"[^a-z0-9]+", "_", name.lower())
        of = "command" if re.search(_KINDS[3][1], word) else "position" if re.search("state|joint|obs", word) else ""
        out.columns["time" + (f".{of}" if of else "")] = x.reshape(len(x), -1)[:, 0].astype(float)
    for name, _, x in groups.pop("tactile", [])[:1]:
        if x.ndim in (2, 3, 4):
            full = x[..., None] * np.array([0.0, 0.0, 1.0]) if x.shape[-1] != 3 or x.ndim == 2 else x
            out.arrays[TACTILE] = full.reshape(len(x), -1, full.shape[-2], 3).astype(float)
            out.findings.append(note("topic", f"touch is read from '{name}' {list(x.shape[1:])}", "info"))
    labels: dict[str, list[str]] = {}
    for kind in ("position", "command", "velocity", "effort"):
        for name, stem, x in groups.get(kind, []):
            x = x.reshape(len(x), -1).astype(float)
            own = list(names.get(name, ()))
            if len(own) != x.shape[1]:
                same = [v for k, v in labels.items() if len(v) == x.shape[1] and (k == stem or len(labels) == 1)]
                own = same[0] if same else [f"{stem or 'joint'}{'_' if stem else ''}{k}" for k in range(x.shape[1])]
            if kind == "position":
                labels[stem] = own
            elif labels and not set(own) <= {j for v in labels.values() for j in v}:
                what = f"'{name}' has {x.shape[1]} values, of other joints than the positions"
                out.findings.append(note("topic", f"{what}: not joint targets, left out"))
                continue
            out.columns |= {f"{kind}.{j}": x[:, k] for k, j in enumerate(own)}
    if not any(k.startswith("time") for k in out.columns) and rate:
        length = max((len(x) for x in out.columns.values()), default=0)
        out.columns["time"] = np.arange(length) / rate
        out.findings.append(note("topic", f"{NOMINAL} ({rate:g} Hz)", "info"))
    return out


# -- the readers ------------------------------------------------------------------------------------------------------


class LeRobot:
    """LeRobot v2.1 and v3 (parquet)."""

    needs: ClassVar[str] = "'dexsim[lerobot]'"
    imports: ClassVar[tuple[str, ...]] = ("pyarrow", "pyarrow.parquet")

    def fits(self, path: Path) -> bool:
        return (path / "meta" / "info.json").is_file()

    def count(self, path: Path) -> int:
        return int(files.mapping(path / "meta" / "info.json", "data set")["total_episodes"])

    def read(self, path: Path, episode: int) -> Episode:
        info = files.mapping(path / "meta" / "info.json", "data set")
        place = {"episode_index": episode, "episode_chunk": episode // int(info.get("chunks_size") or 1000)}
        if str(info.get("codebase_version", "")).startswith("v3"):
            place |= self._place(path, episode)
        source = path / _filled(info["data_path"], place)
        if path.resolve() not in source.resolve().parents:
            raise UserError(f"data set {path}: data_path leads out of it")
        features = info["features"]
        keys = [k for k in ("observation.state", "action") if k in features]
        table = _table(source, [*keys, "timestamp", "frame_index"], episode)
        arrays = {k: np.stack([np.asarray(v, float) for v in table[k].to_pylist()]) for k in keys}
        out = Episode({})
        for key, kind in (("observation.state", "position"), ("action", "command")):
            values = arrays.get(key, np.zeros((0, 0)))
            for k, (quantity, joint) in enumerate(_motors(features.get(key, {}).get("names"), values.shape[1])):
                quantity = kind if quantity == "position" else quantity if kind == "position" else ""
                if quantity:
                    out.columns[f"{quantity}.{joint}"] = values[:, k]
        fps = float(info["fps"])
        stamps = np.asarray(table["timestamp"].to_pylist(), float)
        frames = np.asarray(table["frame_index"].to_pylist(), float)
        nominal = np.abs(stamps - stamps[0] - (frames - frames[0]) / fps).max() < 0.01 / fps
        out.columns["time"] = frames / fps if nominal else stamps  # stored as float32
        if nominal:
            out.findings.append(note("topic", f"{NOMINAL} ({fps:g} Hz)", "info"))
        if info.get("robot_type"):
            out.meta["robot"] = str(info["robot_type"])
        return out

    def _place(self, path: Path, episode: int) -> dict[str, Any]:
        """Return where v3 keeps an episode: its chunk and file."""
        for part in sorted((path / "meta" / "episodes").rglob("*.parquet")):
            for row in _table(part, ["data/chunk_index", "data/file_index"], episode).to_pylist():
                return {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
        raise UserError(f"data set {path}: meta/episodes names no episode {episode}")


def _table(path: Path, columns: Sequence[str], episode: int) -> Any:
    """Return the rows of an episode in a parquet file. Not by pyarrow's data sets, whose library alone takes
    what memory a reader has."""
    from pyarrow import compute, parquet

    file = parquet.ParquetFile(path, memory_map=False, pre_buffer=False)
    table = file.read(columns=[*columns, "episode_index"], use_threads=False)
    return table.filter(compute.equal(table["episode_index"], episode))


def _filled(pattern: str, place: Mapping[str, Any]) -> str:
    """Return the path that a pattern such as data/chunk-{chunk_index:03d}/... gives; only whole numbers are put in."""

    def one(found: re.Match[str]) -> str:
        return f"{int(place[found[1]]):0{int(found[2] or 0)}d}"

    return re.sub(r"\{(\w+)(?::0?(\d+)d)?\}", one, str(pattern))


def _motors(names: Any, width: int) -> list[tuple[str, str]]:
    """Return (quantity, joint) of each value of a LeRobot feature, by its names: a list, or lists under one word."""
    if isinstance(names, dict):
        names = [x for v in names.values() for x in (v if isinstance(v, list) else [v])]
    if not isinstance(names, list) or len(names) != width:
        names = [f"joint{k}" for k in range(width)]
    kinds = {"pos": "position", "vel": "velocity", "torque": "effort", "effort": "effort", "current": "effort"}
    out = []
    for name in map(str, names):
        joint, _, end = name.rpartition(".")
        out.append((kinds[end], joint) if joint and end in kinds else ("position", name))
    return out


class Zarr:
    """Zarr v2 and v3."""

    needs: ClassVar[str] = "'dexsim[zarr]'"
    imports: ClassVar[tuple[str, ...]] = ("zarr",)

    def fits(self, path: Path) -> bool:
        inside = any((path / n).is_file() for n in (".zgroup", "zarr.json", ".zattrs"))
        return inside or path.name.endswith((".zarr", ".zarr.zip"))

    def _open(self, path: Path) -> Any:
        zarr = import_module("zarr")
        return zarr.open_group(zarr.storage.ZipStore(path) if path.is_file() else str(path), mode="r")

    def _groups(self, group: Any) -> list[str]:
        """Return the groups that are an episode each; none where the arrays stand beside each other."""
        found = [k for k, g in group.groups() if k not in ("data", "meta") and any(True for _ in g.arrays())]
        return sorted(found, key=_natural)

    def count(self, path: Path) -> int:
        group = self._open(path)
        if "meta" in group and "episode_ends" in group["meta"]:
            return int(group["meta"]["episode_ends"].shape[0])
        return max(len(self._groups(group)), 1)

    def read(self, path: Path, episode: int) -> Episode:
        group = self._open(path)
        part: slice = slice(None)
        if "meta" in group and "episode_ends" in group["meta"]:
            ends = np.r_[0, np.asarray(group["meta"]["episode_ends"][:])]
            part, source = slice(int(ends[episode]), int(ends[episode + 1])), group["data"]
        else:
            several = self._groups(group)
            source = group[several[episode]] if several else group["data"] if "data" in group else group
        arrays, names = {}, {}
        for key, x in source.arrays():
            if quantity_of(key)[0] and x.ndim:
                arrays[key] = x[part]
                names[key] = _texts(x.attrs.get("joint_names") or x.attrs.get("names"))
        about = dict(group.attrs) | dict(source.attrs)
        shared = _texts(about.get("joint_names"))
        names = {k: v or shared for k, v in names.items()}
        return of_arrays(arrays, names, _rate(about))


class Hdf5:
    """ALOHA's and robomimic's HDF5."""

    needs: ClassVar[str] = "'dexsim[hdf5]'"
    imports: ClassVar[tuple[str, ...]] = ("h5py",)

    def fits(self, path: Path) -> bool:
        return path.suffix.lower() in (".hdf5", ".h5")

    def count(self, path: Path) -> int:
        with import_module("h5py").File(path, "r") as file:
            return max(len(self._demos(file)), 1)

    def _demos(self, file: Any) -> list[str]:
        return sorted((k for k in file["data"] if k.startswith("demo")), key=_natural) if "data" in file else []

    def read(self, path: Path, episode: int) -> Episode:
        h5py = import_module("h5py")
        with h5py.File(path, "r") as file:
            demos = self._demos(file)
            root = file["data"][demos[episode]] if demos else file
            found: dict[str, Any] = {}
            for group in (root, *(root[k] for k in ("obs", "observations") if k in root)):
                arrays = {k: x for k, x in group.items() if isinstance(x, h5py.Dataset)}
                found |= {k: x for k, x in arrays.items() if x.ndim}
            if demos and "actions" in found and "joint_actions" in found:
                found.pop("actions")
            arrays = {k: x[()] for k, x in found.items() if quantity_of(k)[0]}
            names = {k: _texts(found[k].attrs.get("joint_names")) for k in arrays}
            about = dict(file.attrs) | (dict(file["data"].attrs) if demos else {}) | dict(root.attrs)
        if (spec := about.get("env_args")) is not None:
            about |= (json.loads(spec).get("env_kwargs") or {}) if isinstance(spec, str) else {}
        return of_arrays(arrays, names, _rate(about))


class Torch:
    """A dictionary of plain tensors; anything else in it is refused, for a pickle runs code."""

    needs: ClassVar[str] = "torch"
    imports: ClassVar[tuple[str, ...]] = ("torch",)

    def fits(self, path: Path) -> bool:
        return path.suffix.lower() in (".pt", ".pth")

    def count(self, path: Path) -> int:
        return 1

    def read(self, path: Path, episode: int) -> Episode:
        torch = import_module("torch")
        try:
            found = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            raise UserError(
                f"recording {path}: holds more than plain tensors ({brief(str(error).splitlines()[0])}); save a "
                "dictionary of tensors: torch.save({'time': t, 'des_dof_pos': c, 'dof_pos': q}, ...)"
            ) from None
        if not isinstance(found, dict):
            raise UserError(f"recording {path}: must hold a dictionary of tensors by name")
        arrays = {str(k): x.detach().cpu().numpy() for k, x in found.items() if hasattr(x, "detach")}
        names = _texts(found.get("joint_names"))
        return of_arrays(arrays, dict.fromkeys(arrays, names), _rate(found))


def _rate(about: Mapping[str, Any]) -> float | None:
    """Samples a second [Hz] that a data set states."""
    for key in ("control_freq", "fps", "rate", "frequency", "ctrl_freq", "hz"):
        value = about.get(key)
        if isinstance(value, (int, float, np.number)) and 0.1 < float(value) < 1e5:
            return float(value)
    return None


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [x.strip() for x in value.split(",")]
    return [x.decode() if isinstance(x, bytes) else str(x) for x in value] if isinstance(value, Iterable) else []


def _natural(name: str) -> list[Any]:
    return [int(x) if x.isdecimal() else x for x in re.split(r"(\d+)", name)]
