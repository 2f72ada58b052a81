"""Damage to files: bytes, texts, trees, and recordings that are sound as files but hold what no machine sends. A seed
makes a case."""

from __future__ import annotations

import copy
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from dexsim.recording import write

from . import corpus, mjcf

ODD: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2**31,
    2**63,
    -(2**63),
    1e-300,
    1e300,
    float("nan"),
    float("inf"),
    float("-inf"),
    "",
    " ",
    "x",
    "unknown",
    "1e3",
    "*",
    "nan",
    "0 0 -9.81",
    "a" * 5000,
    "\u0000",
    "é\u202e",
    [],
    {},
    [[]],
    [1],
    [1, 2],
    [2, 1],
    [1, 2, 3],
    [None],
    ["x"],
    {"value": 1},
    {"value": None},
    {"low": 1},
    {"value": float("nan"), "low": 0, "high": 1},
    {"x": {"y": {"z": 1}}},
    {1: 2},
    {None: None},
    {True: 1},
    "2020-01-01",
    "!!binary x",
    [0] * 200,
    "\n",
    "a: b",
)
WORDS = (
    b"\x00" * 8,
    b"\xff" * 8,
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\x01" + b"\x00" * 7,
    b"\x00\x00\x00\x00\x00\x00\xf0\x7f",
    b"\x00\x00\x00\x00\x00\x00\xf8\x7f",
)


def bytes_(data: bytes, rng: np.random.Generator, others: list[bytes]) -> bytes:
    """Return a few edits of a file's bytes."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 8))):
        n = len(out)
        if not n:
            break
        at, size = int(rng.integers(0, n)), int(min(rng.integers(1, 64) ** 2, n))
        how = rng.integers(0, 9)
        if how == 0:
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif how == 1:
            out[at] = int(rng.integers(0, 256))
        elif how == 2:
            del out[at : at + size]
        elif how == 3:
            out[at:at] = out[at : at + size]
        elif how == 4:
            del out[at:]
        elif how == 5:
            word = WORDS[int(rng.integers(0, len(WORDS)))]
            out[at : at + len(word)] = word
        elif how == 6:
            out[at:at] = rng.integers(0, 256, size % 40, dtype=np.uint8).tobytes()
        elif how == 7:
            other = others[int(rng.integers(0, len(others)))]
            begin = int(rng.integers(0, max(len(other), 1)))
            out[at : at + size] = other[begin : begin + size]
        else:
            out[at : at + size] = bytes(size)
    return bytes(out)


def tree(value: Any, rng: np.random.Generator) -> Any:
    """Return one to three changes of plain data: values replaced, keys lost, renamed, exchanged."""
    root = [copy.deepcopy(value)]
    for _ in range(int(rng.integers(1, 4))):
        node, key = root, 0
        for _ in range(int(rng.integers(0, 7))):
            inner = node[key]
            keys = (
                list(inner) if isinstance(inner, dict) else list(range(len(inner))) if isinstance(inner, list) else []
            )
            if not keys:
                break
            node, key = inner, keys[int(rng.integers(0, len(keys)))]
        odd = copy.deepcopy(ODD[int(rng.integers(0, len(ODD)))])
        how = rng.integers(0, 6)
        if how == 0 and node is not root:
            del node[key]
        elif how == 1 and isinstance(node, dict):
            name = ODD[int(rng.integers(0, len(ODD)))]
            node[name if isinstance(name, (str, int, float, bool, type(None))) else str(name)] = node.pop(key)
        elif how == 2:
            node[key] = [node[key]]
        elif how == 3:
            node[key] = {"value": node[key]}
        else:
            node[key] = odd
    return root[0]


def text_of(kind: str, rng: np.random.Generator) -> bytes:
    """Return a damaged YAML file of a kind."""
    text = yaml.dump(
        tree(corpus.TREES[kind], rng),
        Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper),
        sort_keys=False,
        allow_unicode=True,
    ).encode("utf-8", "surrogatepass")
    return bytes_(text, rng, [text, b"{[&a*a!!python/name:os.system <<: ]}" * 20]) if rng.random() < 0.4 else text


def values(path: Path, rng: np.random.Generator) -> None:
    """Writes a sound file whose values, times or metadata are none that a machine sends."""
    r = corpus.recording(float(rng.choice([0.02, 0.3, 1.2])), bool(rng.random() < 0.2))
    series = [
        s
        for s in (
            r.commands,
            r.states.position,
            r.states.velocity,
            r.states.effort,
            r.temperature,
            r.enabled,
            r.supply_voltage,
            r.tactile,
            r.object_pose,
            r.external_force,
            r.imu,
        )
        if s is not None
    ]
    for _ in range(int(rng.integers(1, 5))):
        s = series[int(rng.integers(0, len(series)))]
        n = len(s.t)
        at = rng.random(n) < rng.choice([0.02, 0.3, 1.0])
        how = rng.integers(0, 8)
        odd = float(rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e300, -1e300, 1e-300, 1e9, 65536.0, -1.0]))
        if how <= 1:
            s.value = s.value.copy()
            s.value[at] = odd
        elif how == 2:
            s.t = s.t + np.where(at, rng.choice([-3.0, 3.0, 1e-9, 600.0, 1e8]), 0.0)
        elif how == 3:
            s.t = np.where(at, s.t[0], s.t)
        elif how == 4:
            s.t = s.t * float(rng.choice([0.0, 1e-6, 1e3, 1e6]))
        elif how == 5:
            s.t, s.value = s.t[: n // 30], s.value[: n // 30]
        elif how == 6:
            s.value = s.value * float(rng.choice([0.0, 1e6, -1.0, 57.3, 4096.0]))
        else:
            s.stamp = np.where(at, float(rng.choice([np.nan, 0.0, 1e8, -5.0])), s.t)
    if rng.random() < 0.4:
        meta = (
            {k: v for k, v in tree({k: str(v) for k, v in r.meta.items()}, rng).items()} if rng.random() < 0.9 else {}
        )
        r.meta = {str(k): str(v) for k, v in meta.items() if str(k) in corpus.schema.KEYS}
    if rng.random() < 0.2:
        r.config = text_of("config", rng).decode("utf-8", "replace")
    write(path, r)


def clean(folder: Path) -> None:
    """Empty a folder of cases."""
    for old in folder.iterdir():
        shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()


def case(kind: str, seed: int, files: dict[str, list[Path]], folder: Path) -> Path:
    """Writes the damaged file of a seed; returns where."""
    rng = np.random.default_rng([seed, sum(map(ord, kind))])
    if kind in ("checkpoint", "manifest", "overrides"):
        return {"checkpoint": _checkpoint, "manifest": _manifest, "overrides": _overrides}[kind](
            rng, files[kind][0], folder
        )
    if kind == "dataset":
        return _dataset(rng, files[kind][int(rng.integers(0, len(files[kind])))], folder)
    if kind == "network":
        return _network(rng, files[kind][0], folder)
    if kind in ("model", "robot"):
        path = folder / "case.xml"
        mjcf.write(path, rng)
        return path
    if kind not in ("recording", "object"):
        path = folder / "case.yaml"
        path.write_bytes(text_of(kind, rng))
        return path
    source = files[kind][int(rng.integers(0, len(files[kind])))]
    if kind == "recording" and rng.random() < 0.5:
        path = folder / "case.mcap"
        try:
            values(path, rng)
            return path
        except Exception:  # what the writer does not take: the bytes of another are damaged instead
            pass
    path = folder / f"case{source.suffix}"
    path.write_bytes(bytes_(source.read_bytes(), rng, [p.read_bytes() for p in files[kind]]))
    return path


def _dataset(rng: np.random.Generator, source: Path, folder: Path) -> Path:
    """Return a damaged file, or a folder with one."""
    path = folder / f"case{''.join(source.suffixes)}"
    if source.is_file():
        path.write_bytes(bytes_(source.read_bytes(), rng, [source.read_bytes()]))
        return path
    shutil.copytree(source, path)
    inside = sorted(p for p in path.rglob("*") if p.is_file())
    one = inside[int(rng.integers(0, len(inside)))]
    if one.suffix == ".json" and rng.random() < 0.7:
        one.write_text(json.dumps(tree(json.loads(one.read_text()), rng), default=str))
    else:
        one.write_bytes(bytes_(one.read_bytes(), rng, [one.read_bytes()]))
    return path


def _network(rng: np.random.Generator, source: Path, folder: Path) -> Path:
    """Return a bundle whose network is damaged, and its digest that of the damaged one."""
    case = folder / "case"
    case.mkdir()
    for name in ("golden.npz", "config.yaml"):
        (case / name).symlink_to(source.with_name(name).resolve())
    data = source.read_bytes()
    head = 4000 if rng.random() < 0.7 else len(data)  # names, shapes and operators stand among few bytes of weights
    at = int(rng.choice([0, len(data) - head]))
    data = data[:at] + bytes_(data[at : at + head], rng, [data[-4000:]]) + data[at + head :]
    (case / "policy.onnx").write_bytes(data)
    manifest = yaml.load(source.with_name("manifest.yaml").read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    manifest["policy"]["sha256"] = hashlib.sha256(data).hexdigest()
    (case / "manifest.yaml").write_text(yaml.dump(manifest, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper)))
    return case


def _checkpoint(rng: np.random.Generator, source: Path, folder: Path) -> Path:
    path = folder / "case.pt"
    how = rng.random()
    if how < 0.3:
        path.write_bytes(bytes_(source.read_bytes(), rng, [source.read_bytes()]))
        return path
    payload = torch.load(source, weights_only=True)
    if how < 0.65:  # its settings: JSON text
        payload["config"] = json.dumps(tree(json.loads(payload["config"]), rng), default=str)
    else:
        payload = tree(payload, rng)
    torch.save(payload, path)
    return path


def _manifest(rng: np.random.Generator, source: Path, folder: Path) -> Path:
    """Return the manifest of a bundle whose other files are sound."""
    case = folder / "case"
    case.mkdir()
    for name in ("policy.onnx", "golden.npz", "config.yaml"):
        (case / name).symlink_to(source.with_name(name).resolve())
    data = tree(yaml.load(source.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader)), rng)
    text = yaml.dump(
        data, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), sort_keys=False, allow_unicode=True
    ).encode("utf-8", "surrogatepass")
    (case / "manifest.yaml").write_bytes(bytes_(text, rng, [text]) if rng.random() < 0.3 else text)
    return case


def _overrides(rng: np.random.Generator, source: Path, folder: Path) -> Path:
    """Return the lines of a command: values and names exchanged, dropped, prefixed."""
    lines = source.read_text().splitlines()
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.integers(0, len(lines)))
        key, _, value = lines[k].partition("=")
        odd = ODD[int(rng.integers(0, len(ODD)))]
        text = odd if isinstance(odd, str) else json.dumps(odd, default=str) if not isinstance(odd, dict) else "{a: 1}"
        how = rng.integers(0, 7)
        if how == 0:
            lines[k] = f"~{key}"
        elif how == 1:
            lines[k] = f"+{key}={value}"
        elif how == 2:
            lines[k] = f"{key}.{lines[int(rng.integers(0, len(lines)))].partition('=')[0]}={value}"
        elif how == 3:
            lines[k] = f"{key.rpartition('.')[0] or key}={text[:200]}"
        elif how == 4:
            lines[k] = bytes_(lines[k].encode(), rng, [b"[{nan,inf}]=~+@*&"]).decode("utf-8", "replace")
        else:
            lines[k] = f"{key}={text[:200]}"
    path = folder / "case.txt"
    path.write_text("\n".join(" ".join(line.split("\n")) for line in lines), encoding="utf-8", errors="surrogatepass")
    return path
