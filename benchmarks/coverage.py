"""Do the touch signals met in training envelop those met elsewhere? Contact force F_i and contact centre mu_i, finger
by finger.

    python -m benchmarks.coverage checkpoint=checkpoints/rotate.pt reality=bench [worlds=48] [seconds=20]
    [other_worlds=48] [other_seconds=20]
                                  [out=out/coverage]
    python -m benchmarks.coverage checkpoint=checkpoints/rotate.pt recording=hand.mcap [meta.KEY=VALUE]

The policy plays with the physics and ranges of its training, then in the other world, or the other side is a recording.
F_i is a pad's summed normal force, mu_i the force-weighted mean of its taxels' positions, here in the pad's own plane;
both as measured, while F_i exceeds CONTACT. Training's region: for F_i the middle 99.8 % of its samples; for mu_i the
cells of CELL that hold at least SHARE of them. A finger's figure is the share of the other side's samples within that
region (100 %: enveloped), and the share of the region that the other side visits; in brackets the 95 % bootstrap over
the other side's worlds (of a recording: its seconds), the region taken as found. Beside it what training's own samples
score, one half of its worlds in the region of the other half: much less than 100 % says that the finger touched too
seldom for its region to be known. A finger that touches seldom needs more worlds and seconds (on a GPU: device=cuda;
the other world runs on the CPU all the same). Writes coverage.png and coverage.json; prints one JSON line.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks import tools
from dexsim import intervals
from dexsim.assets import xhand
from dexsim.cli import machine, start
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile.layout import hand_layout

CONTACT = 0.1  # N
CELL = 0.002  # m
SHARE = 2e-4  # of training's samples in a cell that counts as visited
TAILS = (0.1, 99.9)  # percentiles of F_i
FEWEST = (200, 20)  # samples of training and of the other side, to say anything
RESAMPLES = 1000
OWN = {"checkpoint": "", "reality": "null", "recording": "null", "worlds": "48", "seconds": "20",
       "other_worlds": "null", "other_seconds": "null",
       "seed": "0", "out": "out/coverage"}  # fmt: skip


class Contacts(NamedTuple):
    """One finger's samples in contact: force [T] N, centre [T, 2] m in the pad's plane, block [T] (world, or second of
    a recording: samples of one are not independent)."""

    force: np.ndarray
    centre: np.ndarray
    block: np.ndarray


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
    layout = hand_layout(load_hand())
    return [Plane(layout.point[f, : layout.count[f]]) for f in range(layout.pads)]


def of_contact(force: np.ndarray, local: np.ndarray, block: np.ndarray) -> list[Contacts]:
    """The samples in contact, finger by finger. force [S, 5] N; local [S, 5, 3] m, body frame; block [S]."""
    out = []
    for f, plane in enumerate(planes()):
        on = force[:, f] > CONTACT
        out.append(Contacts(force[on, f], plane(local[on, f]), block[on]))
    return out


def played(argv: list[str], worlds: int, seconds: float, seed: int) -> list[Contacts]:
    """Samples of a policy that plays (`of_contact`)."""
    from dexsim.learning import checkpoint
    from dexsim.learning.ppo import load_policy
    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import make_env

    begun = start.for_play([*argv, f"episodes={worlds}", f"worlds={worlds}", f"seed={seed}"], CONFIGS)
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
    return of_contact(np.concatenate(force), np.concatenate(local), np.tile(np.arange(worlds), len(force)))


def recorded(path: str, meta: dict[str, str]) -> list[Contacts]:
    """Samples of a recording's touch (`of_contact`). Raises UserError where it has none of an xHand's."""
    from dexsim.recording.reader import read

    touch = read(path, meta=meta, audit=False).tactile_newtons()
    layout = hand_layout(load_hand())
    if touch is None or touch.value.shape[1:3] != layout.point.shape[:2]:
        raise UserError(f"recording={path}: has no touch of {layout.pads} pads with {layout.taxels} taxels")
    normal = np.nan_to_num(touch.value[..., 2]).clip(min=0)
    force = normal.sum(-1)
    local = np.einsum("sft,ftc->sfc", normal, layout.point) / np.maximum(force, 1e-9)[..., None]
    return of_contact(force, local, np.floor(touch.t).astype(int))


class Region:
    """What training visits of one finger: a range of forces, cells of the pad."""

    def __init__(self, ours: Contacts):
        self.low, self.high = np.percentile(ours.force, TAILS)
        self.low = min(self.low, CONTACT)
        kinds, count = np.unique(self._cell(ours), axis=0, return_counts=True)
        self.cells = {tuple(c) for c in kinds[count >= max(SHARE * len(ours.force), 1)]}

    def holds(self, theirs: Contacts) -> tuple[np.ndarray, np.ndarray]:
        """(whether the force, whether the centre lies within) of each sample, [T] bool each."""
        centre = np.array([tuple(c) in self.cells for c in self._cell(theirs)], bool)
        return (theirs.force >= self.low) & (theirs.force <= self.high), centre

    def visited(self, theirs: Contacts) -> float:
        """Share of the cells in which there are samples."""
        return len(self.cells & {tuple(c) for c in self._cell(theirs)}) / max(len(self.cells), 1)

    @staticmethod
    def _cell(contacts: Contacts) -> np.ndarray:
        return np.floor(contacts.centre / CELL).astype(int)


def interval(within: np.ndarray, block: np.ndarray, rng: np.random.Generator) -> list[float] | None:
    """95 % interval of the mean of `within` [T], bootstrap over blocks; None with a single block."""
    index = np.unique(block, return_inverse=True)[1]
    count, hits = np.bincount(index), np.bincount(index, within)
    if len(count) < 2:
        return None

    def rate(h: np.ndarray, c: np.ndarray, axis: int = -1) -> np.ndarray:
        return h.sum(axis) / c.sum(axis)

    return intervals.bootstrap((hits, count), rate, rng, RESAMPLES).tolist()


def halves(ours: Contacts, rng: np.random.Generator) -> tuple[float, float] | None:
    """Shares (force, centre) of one half of the blocks within the region of the other half, both ways; None where one
    is empty."""
    blocks = rng.permutation(np.unique(ours.block))
    first = np.isin(ours.block, blocks[: len(blocks) // 2])
    if first.all() or not first.any():
        return None
    parts = [Contacts(*(x[chosen] for x in ours)) for chosen in (first, ~first)]
    found = [Region(a).holds(b) for a, b in (parts, parts[::-1])]
    return tuple(float(np.concatenate(x).mean()) for x in zip(*found, strict=True))


def envelope(ours: Contacts, theirs: Contacts) -> dict[str, Any]:
    """Shares of `theirs` within the region of `ours`, for one finger; None where a side has too few samples to say."""
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {"samples_training": len(ours.force), "samples_other": len(theirs.force)}
    if len(ours.force) < FEWEST[0] or len(theirs.force) < FEWEST[1]:
        return out | {"force_covered": None, "centre_covered": None, "region_visited": None}
    region = Region(ours)
    force, centre = region.holds(theirs)
    own = halves(ours, rng) or (None, None)
    return out | {
        "force_covered": float(force.mean()), "force_interval": interval(force, theirs.block, rng),
        "force_training_halves": own[0],
        "centre_covered": float(centre.mean()), "centre_interval": interval(centre, theirs.block, rng),
        "centre_training_halves": own[1],
        "region_visited": region.visited(theirs), "force_high_training_N": float(region.high),
        "force_high_other_N": float(np.percentile(theirs.force, TAILS[1])),
    }  # fmt: skip


def draw(ours: list, theirs: list, label: str, found: dict, path: Path) -> None:
    """Contact centres on each pad above, distributions of the force below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5.2), layout="constrained")
    axes = figure.subplots(2, 5)
    layout, rng = hand_layout(load_hand()), np.random.default_rng(0)
    for f, (finger, plane) in enumerate(zip(xhand.FINGERS, planes(), strict=True)):
        top, bottom = axes[0, f], axes[1, f]
        top.scatter(*(1000 * plane(layout.point[f, : layout.count[f]])).T, s=2, color="0.8")
        for (force, mu, _), color, name in ((ours[f], "#9dbfe3", "training"), (theirs[f], "#c0392b", label)):
            pick = rng.permutation(len(force))[:3000]
            top.scatter(*(1000 * mu[pick]).T, s=3, color=color, alpha=0.4, linewidths=0, label=name)
            if len(force):
                bottom.hist(force, bins=np.linspace(0, 15, 60), density=True, color=color, alpha=0.6, label=name)
        say = found[finger]
        covered = (
            "too few contacts"
            if say["force_covered"] is None
            else f"mu {100 * say['centre_covered']:.1f} %, F {100 * say['force_covered']:.1f} %"
        )
        top.set_title(f"{finger}: {covered}", fontsize=9)
        top.set_aspect("equal")
        top.set_xlabel("mm", fontsize=8)
        bottom.set_xlabel("F [N]", fontsize=8)
        bottom.set_yscale("log")
    axes[1, 0].legend(fontsize=7)  # its patches are seen at any size; points of a scatter are not
    figure.savefig(path, dpi=110)


def main(argv: list[str]) -> int:
    own, rest = tools.split(argv, OWN)
    if not own["checkpoint"]:
        raise UserError("checkpoint=PATH: say whose training is meant, e.g. checkpoint=checkpoints/rotate.pt")
    if (own["reality"] == "null") == (own["recording"] == "null"):
        raise UserError("say what to compare with: reality=bench, or recording=FILE.mcap")
    for key in ("worlds", "seconds"):
        own[f"other_{key}"] = own[key] if own[f"other_{key}"] == "null" else own[f"other_{key}"]
    worlds, other_worlds = (tools.numbers(own[k], k)[0] for k in ("worlds", "other_worlds"))
    try:
        seconds, other_seconds, seed = float(own["seconds"]), float(own["other_seconds"]), int(own["seed"])
    except ValueError:
        raise UserError(
            f"seconds={own['seconds']} other_seconds={own['other_seconds']} seed={own['seed']}: "
            "must be numbers, the seed a whole one"
        ) from None
    for key, value in (("seconds", seconds), ("other_seconds", other_seconds)):
        if not 0.1 <= value <= 1e5:
            raise UserError(f"{key}={value:g}: must lie in [0.1, 100000]")
    meta = {k.removeprefix("meta."): v for k, _, v in (a.partition("=") for a in rest) if k.startswith("meta.")}
    settings = [f"checkpoint={own['checkpoint']}", *(a for a in rest if not a.startswith("meta."))]
    ours = played(settings, worlds, seconds, seed)
    if own["recording"] != "null":
        theirs, label = recorded(own["recording"], meta), "recording"
    else:
        elsewhere = [*settings, "device=cpu", f"reality={own['reality']}"]  # C MuJoCo steps it, whatever trained
        theirs, label = played(elsewhere, other_worlds, other_seconds, seed + 1), f"reality={own['reality']}"
    found = {finger: envelope(a, b) for finger, a, b in zip(xhand.FINGERS, ours, theirs, strict=True)}
    out = Path(own["out"]).expanduser()
    out.mkdir(parents=True, exist_ok=True)
    draw(ours, theirs, label, found, out / "coverage.png")

    def say(e: dict, name: str) -> str:
        if e[f"{name}_covered"] is None:
            return "-"
        ends = e[f"{name}_interval"]
        return (
            f"{100 * e[f'{name}_covered']:.1f}"
            + ("" if ends is None else f" ({100 * ends[0]:.1f}-{100 * ends[1]:.1f})")
            + " %"
        )

    def share(v: float | None) -> str:
        return "-" if v is None else f"{100 * v:.1f} %"

    print(
        f"{'finger':8}{'F within (95 %)':>24}{'mu within (95 %)':>24}{'mu, own halves':>16}"
        f"{'region visited':>16}{'samples':>18}   (training | {label})"
    )
    for finger, e in found.items():
        print(
            f"{finger:8}{say(e, 'force'):>24}{say(e, 'centre'):>24}"
            f"{share(e.get('centre_training_halves')):>16}{share(e['region_visited']):>16}"
            f"{e['samples_training']:>10}|{e['samples_other']}"
        )
    result = {"benchmark": "coverage", "other": label, "fingers": found, "plot": str(out / "coverage.png")}
    (out / "coverage.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
