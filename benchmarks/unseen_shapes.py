"""Judge a grasp policy on shapes that nobody has judged on before.

    python -m benchmarks.unseen_shapes [checkpoint=checkpoints/grasp.pt] [count=16] [episodes=512]
        [out=out/unseen_shapes] [any other setting of play.py]

Shapes are generated from a seed that is a hash of this file and of the checkpoint, so neither a policy nor a generator
can have been chosen by how it fares on them: another checkpoint, or any change here, makes others. Half are
superellipsoids, half convex hulls of random points; their extents are within those of the shapes trained on. Writes
out/shapes/*.stl and what `play.py` writes, and prints the shares held, with intervals.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh

from benchmarks import tools
from benchmarks.options import options
from dexsim.errors import UserError

OWN = {"checkpoint": "checkpoints/grasp.pt", "count": 16, "episodes": 512, "out": "out/unseen_shapes"}
LONGEST = (0.075, 0.090)  # m: 60 mm by the scales 1.25 to 1.5, as the library's are in training
RATIO = (0.55, 1.0)  # of the other two extents to it: wedge 0.57, sphere 1
EXPONENT = (0.2, 1.8)  # of a superellipsoid: 0 a box, 1 an ellipsoid, 2 an octahedron
POINTS = 14  # of a random hull


def seed_of(checkpoint: Path) -> int:
    """Return a number of this file and the checkpoint. Raises UserError where there is none."""
    if not checkpoint.is_file():
        raise UserError(f"checkpoint={checkpoint}: no such file")
    digest = hashlib.sha256(Path(__file__).read_bytes() + checkpoint.read_bytes())
    return int.from_bytes(digest.digest()[:8], "big")


def superellipsoid(rng: np.random.Generator) -> np.ndarray:
    """Points [P, 3] on x = c(u, a) c(v, b), y = c(u, a) s(v, b), z = s(u, a) (Barr 1981, Superquadrics and
    angle-preserving transformations), a, b drawn."""
    a, b = rng.uniform(*EXPONENT, 2)
    u, v = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 13), np.linspace(-np.pi, np.pi, 25)[:-1])

    def power(x: np.ndarray, e: float) -> np.ndarray:
        return np.sign(x) * np.abs(x) ** e

    x, y = power(np.cos(u), a) * power(np.cos(v), b), power(np.cos(u), a) * power(np.sin(v), b)
    return np.stack([x, y, power(np.sin(u), a)], -1).reshape(-1, 3)


def polyhedron(rng: np.random.Generator) -> np.ndarray:
    """Points [P, 3] evenly over the unit sphere, their radii drawn."""
    p = rng.normal(size=(POINTS, 3))
    return p / np.linalg.norm(p, axis=1, keepdims=True) * rng.uniform(0.7, 1.0, (POINTS, 1))


def generate(seed: int, count: int, folder: Path) -> list[Path]:
    """`count` convex meshes as STL, metres."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k in range(count):
        name, make = (("superellipsoid", superellipsoid), ("polyhedron", polyhedron))[k % 2]
        p = make(rng)
        longest = rng.uniform(*LONGEST)
        extent = longest * np.array([1.0, *rng.uniform(*RATIO, 2)])
        p = (p - (p.max(0) + p.min(0)) / 2) / np.ptp(p, axis=0) * rng.permutation(extent)
        p += rng.normal(scale=2e-5, size=p.shape)  # flat faces of many points have no one hull
        mesh = trimesh.convex.convex_hull(p)
        if not mesh.is_watertight:
            raise AssertionError(f"shape {k} of seed {seed:016x} is not closed")
        paths.append(folder / f"{k:02d}_{name}.stl")
        mesh.export(paths[-1])
    return paths


def said(metrics: dict, key: str) -> str:
    """Return a share held, with its 95 % interval."""
    share = metrics[key]
    if share is None:
        return "no such episodes"
    low, high = metrics[f"{key}_interval"]
    return f"{100 * share:.1f} % ({100 * low:.1f}-{100 * high:.1f})"


def main(argv: list[str]) -> None:
    extra: list[str] = []
    own = options(argv, OWN, extra)
    checkpoint, out = Path(own["checkpoint"]).expanduser().absolute(), Path(own["out"]).expanduser().absolute()
    seed, count = seed_of(checkpoint), own["count"]
    paths = generate(seed, count, out / "shapes")
    print(f"{count} shapes of seed {seed:016x}: {out / 'shapes'}", flush=True)
    command = [sys.executable, "play.py", f"checkpoint={checkpoint}", f"episodes={own['episodes']}", "video=false",
               "object_hulls=1", f"kept_out=[{','.join(map(str, paths))}]", *extra, f"out={out / 'play'}"]  # fmt: skip
    status = subprocess.run(command, cwd=tools.ROOT).returncode
    if status:
        raise UserError(f"play.py ended with {status}; what it said is above")
    m = json.loads((out / "play" / "metrics.json").read_text())
    by = {k: v for k, v in m["hold_rate_by_object"].items() if Path(k).suffix == ".stl"}
    print(f"{m['episodes_kept_out']} episodes on shapes that nobody has judged on")
    print("held, command >= 0.1, no push: " + said(m, "hold_rate_kept_out_shapes_unpushed"))
    print("held under a push, where the command can carry it: " + said(m, "hold_rate_kept_out_shapes"))
    for k, v in by.items():
        print(f"  {Path(k).stem:20s} " + ("-" if v is None else f"{100 * v:.0f} %"))


if __name__ == "__main__":
    tools.command(main, __doc__)
