"""Do the touch signals met in training envelop those met elsewhere? Contact force F_i and contact centre mu_i, finger by finger.

    python -m benchmarks.coverage checkpoint=checkpoints/rotate.pt reality=bench [worlds=48] [seconds=20] [out=out/coverage]
    python -m benchmarks.coverage checkpoint=checkpoints/rotate.pt recording=hand.mcap [meta.KEY=VALUE]

The policy plays with the physics and ranges of its training, then in the other world, or the other side is a recording.
F_i is a pad's summed normal force, mu_i the force-weighted mean of its taxels' positions, here in the pad's own plane; both as
measured, while F_i exceeds CONTACT. Training's region: for F_i the middle 99.8 % of its samples; for mu_i the cells of CELL
that hold at least SHARE of them. A finger's figure is the share of the other side's samples within that region (100 %:
enveloped), and the share of the region that the other side visits. Writes coverage.png and coverage.json; prints one JSON line.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import torch

from benchmarks import tools
from dexsim.assets import xhand
from dexsim.cli import machine, start
from dexsim.cli.ending import guard
from dexsim.errors import UserError
from dexsim.tactile.layout import xhand_layout

CONTACT = 0.1  # N
CELL = 0.002  # m
SHARE = 2e-4  # of training's samples in a cell that counts as visited
TAILS = (0.1, 99.9)  # percentiles of F_i
OWN = {"checkpoint": "", "reality": "null", "recording": "null", "worlds": "48", "seconds": "20", "seed": "0", "out": "out/coverage"}


class Plane:
    """A pad's plane: its middle and the two directions in which its taxels spread most, body frame."""

    def __init__(self, points: np.ndarray):
        self.middle = points.mean(0)
        self.axes = np.linalg.svd(points - self.middle, full_matrices=False)[2][:2]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """[T, 2] m of body-frame points [T, 3]."""
        return (points - self.middle) @ self.axes.T


def planes() -> list[Plane]:
    """One of each finger's pad."""
    layout = xhand_layout()
    return [Plane(layout.point[f, : layout.count[f]]) for f in range(layout.pads)]


def of_contact(force: np.ndarray, local: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each finger (F [T] N, mu [T, 2] m in the pad's plane) of the samples in contact. force [S, 5] N; local [S, 5, 3] m,
    body frame."""
    out = []
    for f, plane in enumerate(planes()):
        on = force[:, f] > CONTACT
        out.append((force[on, f], plane(local[on, f])))
    return out


def played(argv: list[str], worlds: int, seconds: float, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Samples of a policy that plays (`of_contact`)."""
    from dexsim.cli.build import quiet_warp
    from dexsim.learning import checkpoint
    from dexsim.learning.ppo import load_policy
    from dexsim.tasks import make_env

    begun = start.for_play([*argv, f"episodes={worlds}", f"worlds={worlds}", f"seed={seed}"], tools.ROOT / "configs")
    cfg = begun.cfg
    machine.set_threads(cfg["device"])
    quiet_warp(cfg["device"])
    torch.manual_seed(seed)
    env = make_env(cfg, worlds, cfg["device"], seed, cfg["sim"]["engine"])
    checkpoint.check_layout(begun.data, checkpoint.layout_of(env), str(begun.source))
    policy = load_policy(begun.data, env, str(begun.source))
    if hasattr(env, "end_curriculum"):
        env.end_curriculum()
    force, local = [], []
    with torch.inference_mode():
        obs = env.get_observations()
        for _ in range(int(round(seconds / env.dt))):
            obs = env.step(policy(obs))[0]
            pos, rot = env.engine.t.xpos[:, env.tip_body].float(), env.engine.t.xmat[:, env.tip_body].float()
            force.append(env.touch.force.cpu().numpy().copy())
            local.append((rot.transpose(-1, -2) @ (env.touch.centre - pos)[..., None])[..., 0].cpu().numpy())
    return of_contact(np.concatenate(force), np.concatenate(local))


def recorded(path: str, meta: dict[str, str]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Samples of a recording's touch (`of_contact`). Raises UserError where it has none of an xHand's."""
    from dexsim.recording.reader import read

    touch = read(path, meta=meta, audit=False).tactile_newtons()
    layout = xhand_layout()
    if touch is None or touch.value.shape[1:3] != layout.point.shape[:2]:
        raise UserError(f"recording={path}: has no touch of {layout.pads} pads with {layout.taxels} taxels")
    normal = np.nan_to_num(touch.value[..., 2]).clip(min=0)
    force = normal.sum(-1)
    local = np.einsum("sft,ftc->sfc", normal, layout.point) / np.maximum(force, 1e-9)[..., None]
    return of_contact(force, local)


def envelope(ours: tuple[np.ndarray, np.ndarray], theirs: tuple[np.ndarray, np.ndarray]) -> dict[str, float | int | None]:
    """Shares of `theirs` within the region of `ours`, for one finger; None where a side has too few samples to say."""
    out: dict[str, float | int | None] = {"samples_training": len(ours[0]), "samples_other": len(theirs[0])}
    if len(ours[0]) < 200 or len(theirs[0]) < 20:
        return out | {"force_covered": None, "centre_covered": None, "region_visited": None}
    low, high = np.percentile(ours[0], TAILS)
    low = min(low, CONTACT)
    cells = [np.floor(mu / CELL).astype(int) for mu in (ours[1], theirs[1])]
    kinds, count = np.unique(cells[0], axis=0, return_counts=True)
    region = {tuple(c) for c in kinds[count >= max(SHARE * len(cells[0]), 1)]}
    inside = np.array([tuple(c) in region for c in cells[1]])
    visited = {tuple(c) for c in cells[1][inside]}
    return out | {
        "force_covered": float(((theirs[0] >= low) & (theirs[0] <= high)).mean()), "centre_covered": float(inside.mean()),
        "region_visited": len(visited) / max(len(region), 1), "force_high_training_N": float(high),
        "force_high_other_N": float(np.percentile(theirs[0], TAILS[1])),
    }  # fmt: skip


def draw(ours: list, theirs: list, label: str, found: dict, path: Path) -> None:
    """Contact centres on each pad above, distributions of the force below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5.2), layout="constrained")
    axes = figure.subplots(2, 5)
    layout, rng = xhand_layout(), np.random.default_rng(0)
    for f, (finger, plane) in enumerate(zip(xhand.FINGERS, planes(), strict=True)):
        top, bottom = axes[0, f], axes[1, f]
        top.scatter(*(1000 * plane(layout.point[f, : layout.count[f]])).T, s=2, color="0.8")
        for (force, mu), color, name in ((ours[f], "#9dbfe3", "training"), (theirs[f], "#c0392b", label)):
            pick = rng.permutation(len(force))[:3000]
            top.scatter(*(1000 * mu[pick]).T, s=3, color=color, alpha=0.4, linewidths=0, label=name)
            if len(force):
                bottom.hist(force, bins=np.linspace(0, 15, 60), density=True, color=color, alpha=0.6, label=name)
        say = found[finger]
        covered = "too few contacts" if say["force_covered"] is None else f"mu {100 * say['centre_covered']:.1f} %, F {100 * say['force_covered']:.1f} %"
        top.set_title(f"{finger}: {covered}", fontsize=9)
        top.set_aspect("equal")
        top.set_xlabel("mm", fontsize=8)
        bottom.set_xlabel("F [N]", fontsize=8)
        bottom.set_yscale("log")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=110)


def main(argv: list[str]) -> int:
    own, rest = tools.split(argv, OWN)
    if not own["checkpoint"]:
        raise UserError("checkpoint=PATH: say whose training is meant, e.g. checkpoint=checkpoints/rotate.pt")
    if (own["reality"] == "null") == (own["recording"] == "null"):
        raise UserError("say what to compare with: reality=bench, or recording=FILE.mcap")
    worlds = tools.numbers(own["worlds"], "worlds")[0]
    try:
        seconds, seed = float(own["seconds"]), int(own["seed"])
    except ValueError:
        raise UserError(f"seconds={own['seconds']} seed={own['seed']}: must be a number, and a whole number") from None
    if not 0.1 <= seconds <= 1e5:
        raise UserError(f"seconds={seconds:g}: must lie in [0.1, 100000]")
    meta = {k.removeprefix("meta."): v for k, _, v in (a.partition("=") for a in rest) if k.startswith("meta.")}
    settings = [f"checkpoint={own['checkpoint']}", *(a for a in rest if not a.startswith("meta."))]
    ours = played(settings, worlds, seconds, seed)
    if own["recording"] != "null":
        theirs, label = recorded(own["recording"], meta), "recording"
    else:
        theirs, label = played([*settings, f"reality={own['reality']}"], worlds, seconds, seed + 1), f"reality={own['reality']}"
    found = {finger: envelope(a, b) for finger, a, b in zip(xhand.FINGERS, ours, theirs, strict=True)}
    out = Path(own["out"]).expanduser()
    out.mkdir(parents=True, exist_ok=True)
    draw(ours, theirs, label, found, out / "coverage.png")

    def say(v: float | None) -> str:
        return "-" if v is None else f"{100 * v:.1f} %"

    print(f"{'finger':8}{'F within':>12}{'mu within':>12}{'region visited':>16}{'samples':>18}   (training | {label})")
    for finger, e in found.items():
        print(f"{finger:8}{say(e['force_covered']):>12}{say(e['centre_covered']):>12}{say(e['region_visited']):>16}"
              f"{e['samples_training']:>10}|{e['samples_other']}")
    result = {"benchmark": "coverage", "other": label, "fingers": found, "plot": str(out / "coverage.png")}
    (out / "coverage.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
