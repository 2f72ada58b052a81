"""Physics settings: what each costs and what it does to a grasp.

    python -m benchmarks.physics [worlds=8192] [only=chosen,pyramidal] [minutes=20] [out=out/physics] [device=cuda:0]
                                 [policy=checkpoints/grasp.pt] [any other setting of train.py]

A trained policy grasps in all worlds at the chosen settings (palm up, command 0.6, no pushes). That moment is put into
an environment of each of the settings below, one changed at a time, and the joint targets are held for 5 s: 0.5 s to
settle, then the palm is turned face down within 0.5 s, so that friction carries the object. Of the worlds that held at
the start:
  held       share whose object is within 30 mm of its place at the end; hold_s: mean time until it left
  creep      mm/s of the object in the last 2 s, of those that hold: median, 95th percentile
  depth      mm of penetration at the end: 95th percentile of fingertips (whose rubber is meant to yield) and of all
  else K          force over depth of fingertips over the stiffness set, median: 1 means that the rubber is as soft as
  asked contacts, rows a world; newton: mean iterations
  steps/s    environment steps a second that physics and servo alone would allow, from the settled grasp
Writes physics.md, physics.json and physics.png to `out`; join=a/physics.json,b/physics.json puts several runs into one.
"""

from __future__ import annotations

import contextlib
import gc
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

import dexsim.tasks.env as env_module
from benchmarks import tools
from dexsim.assets import xhand
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy
from dexsim.sim.engine import OVERFLOW_BITS
from dexsim.sim.scene import OBJECT
from dexsim.tasks import make_env

SETTLE_S, TURN_S, HOLD_S, CREEP_S, LEFT = 0.5, 0.5, 4.0, 2.0, 0.030
COMMAND = 0.6
ALONE = 4
"""A contact bit that nothing answers to (the object has contype 1, conaffinity 2)."""


def _pyramidal(spec: mujoco.MjSpec) -> None:
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


def _newton(iterations: int) -> dict[str, int]:
    """Newton iterations at most, of either engine."""
    return {"iterations": iterations, "iterations_mujoco": iterations}


def _ccd(**options: float) -> Callable[[mujoco.MjSpec], None]:
    """Options of convex collision: ccd_tolerance [m], ccd_iterations."""

    def edit(spec: mujoco.MjSpec) -> None:
        for name, value in options.items():
            setattr(spec.option, name, value)

    return edit


def _no_self(spec: mujoco.MjSpec) -> None:
    """The hand touches the object only."""
    for geom in spec.geoms:
        if not geom.name.startswith(OBJECT):
            geom.contype, geom.conaffinity = ALONE, 1


def _tips_only(spec: mujoco.MjSpec) -> None:
    """Only fingertips and palm touch the object; the hand does not touch itself."""
    keep = {*xhand.TIP_GEOMS}
    for geom in spec.geoms:
        if not geom.name.startswith(OBJECT):
            on = geom.name in keep or geom.parent.name == "right_hand_link"
            geom.contype, geom.conaffinity = ALONE, 1 if on else ALONE << 1


def _soft_links(spec: mujoco.MjSpec) -> None:
    """Links, palm and object yield as by MuJoCo's default (fingertips have their rubber's stiffness)."""
    for geom in spec.geoms:
        if geom.name not in xhand.TIP_GEOMS:
            geom.solimp = [0.9, 0.95, 1e-3, 0.5, 2.0]


@dataclass(frozen=True)
class Setting:
    """Values of `sim` that differ from the chosen ones; edit changes the model."""

    sim: dict[str, Any] = field(default_factory=dict)
    edit: Callable[[mujoco.MjSpec], None] | None = None


SETTINGS = {
    "chosen": Setting(),
    "reference 1 ms x 21": Setting({"timestep": 0.001, "ls_iterations": 50} | _newton(50)),
    "3.5 ms x 6": Setting({"timestep": 0.0035}),
    "5.25 ms x 4": Setting({"timestep": 0.00525}),
    "10.5 ms x 2": Setting({"timestep": 0.0105}),
    "pyramidal": Setting({"njmax": 256}, _pyramidal),
    "iterations 4": Setting(_newton(4)),
    "iterations 6": Setting(_newton(6)),
    "iterations 12": Setting(_newton(12)),
    "iterations 20": Setting(_newton(20)),
    "impratio 1": Setting({"impratio": 1.0}),
    "impratio 3": Setting({"impratio": 3.0}),
    "impratio 10": Setting({"impratio": 10.0}),
    "impratio 20": Setting({"impratio": 20.0}),
    "ls_iterations 5": Setting({"ls_iterations": 5}),
    "ls_iterations 10": Setting({"ls_iterations": 10}),
    "ls_iterations 50": Setting({"ls_iterations": 50}),
    "noslip 3": Setting({"noslip_iterations": 3}),
    "njmax 256": Setting({"njmax": 256}),
    "njmax 112": Setting({"njmax": 112}),
    "nconmax 48": Setting({"nconmax": 48}),
    "links and palm softer (solimp 0.9)": Setting({}, _soft_links),
    "ccd_tolerance 1e-5": Setting({}, _ccd(ccd_tolerance=1e-5)),
    "ccd_tolerance 1e-4": Setting({}, _ccd(ccd_tolerance=1e-4)),
    "ccd_iterations 12": Setting({}, _ccd(ccd_iterations=12)),
    "hand does not touch itself": Setting({}, _no_self),
    "only tips and palm touch": Setting({}, _tips_only),
}


@contextlib.contextmanager
def edited(edit: Callable[[mujoco.MjSpec], None] | None) -> Iterator[None]:
    """Environments made inside get `edit` after their own solver options."""
    own = env_module._solver_options

    def options(spec: mujoco.MjSpec, sim: dict, engine: str) -> None:
        own(spec, sim, engine)
        for geom in list(spec.geoms):  # what only a picture needs would come to life
            if not geom.contype and not geom.conaffinity:
                spec.delete(geom)
        if edit is not None:
            edit(spec)

    env_module._solver_options = options
    try:
        yield
    finally:
        env_module._solver_options = own


def _grasp(cfg: dict, policy_file: str) -> tuple[Any, tools.Snapshot]:
    """(environment at the chosen settings, its worlds in a grasp)."""
    env = make_env(cfg, cfg["worlds"], cfg["device"], 0, cfg["sim"]["engine"])
    policy = load_policy(checkpoint.load(policy_file, cfg["device"]), env, policy_file)
    env.fixed_command = torch.full((env.num_envs,), COMMAND, device=env.device)
    env.pushes = False
    env.reset_all()
    obs = env.get_observations()
    with torch.no_grad():
        for _ in range(int(round(3.0 / env.dt))):
            obs = env.step(policy(obs))[0]
    return env, tools.Snapshot(env)


def _contacts(env: Any, worlds: int = 64) -> dict[str, np.ndarray]:
    """Present contacts of a few worlds: depth [mm], whether of a fingertip on the object, normal force where it is one
    [N]."""
    e = env.engine
    tips = [e.geom(g) for g in xhand.TIP_GEOMS]
    body = e.body(OBJECT)
    on_object = e.mjm.geom_bodyid == body
    if e.kind == "warp":
        n = int(e.d.nacon.numpy()[0])
        c = e.d.contact
        geom, depth = c.geom.numpy()[:n], (c.includemargin.numpy() - c.dist.numpy())[:n]
        world, active = c.worldid.numpy()[:n], c.efc_address.numpy()[:n, 0] >= 0
    else:
        rows = []
        for w in range(min(worlds, e.n)):
            model, data = e.batch.get_model(w), e.batch.get_data(w)
            mujoco.mj_forward(model, data)
            rows += [(w, *c.geom, c.includemargin - c.dist, c.efc_address >= 0) for c in data.contact]
        table = np.array(rows).reshape(-1, 5)
        world, geom, depth, active = table[:, 0].astype(int), table[:, 1:3].astype(int), table[:, 3], table[:, 4] > 0
    tip = (np.isin(geom[:, 0], tips) & on_object[geom[:, 1]]) | (np.isin(geom[:, 1], tips) & on_object[geom[:, 0]])
    touching = active & (depth > 0)
    touches_object = on_object[geom].any(1)
    # stiffness: fingertips with one contact on the object
    finger = np.where(np.isin(geom[:, 0], tips), geom[:, 0], geom[:, 1])
    key = world * 10000 + finger
    keys, first, count = np.unique(key[tip & touching], return_index=True, return_counts=True)
    index = np.flatnonzero(tip & touching)[first[count == 1]]
    column = np.array([tips.index(f) for f in finger[index]], dtype=int)
    force = e.t.pair_normal.cpu().numpy()[world[index], column]
    stiffness = env.objects.stiffness.cpu().numpy()[world[index]]
    firm = force > 0.5
    return {
        "world": world[touching], "tip": 1e3 * depth[tip & touching],
        "other": 1e3 * depth[touching & ~tip & touches_object],
        "k": (force / np.maximum(depth[index], 1e-9) / stiffness)[firm],
    }  # fmt: skip


def _hold(env: Any, grasp: tools.Snapshot, stiffness: torch.Tensor) -> dict[str, float]:
    """The fidelity columns."""
    e, k, dt = env.engine, env.decimation, env.dt
    grasp.restore(env, fields=True)
    env.objects.stiffness.copy_(stiffness)
    gravity = e.field("opt.gravity")
    turn, end = int(round(TURN_S / dt)), int(round((SETTLE_S + HOLD_S + TURN_S) / dt))
    settle, late = int(round(SETTLE_S / dt)), end - int(round(CREEP_S / dt))
    place, start = None, None
    alive = torch.ones(e.n, dtype=torch.bool, device=e.device)
    time_held = torch.zeros(e.n, device=e.device)
    for step in range(end):
        angle = np.pi * min(max((step - settle) / turn, 0.0), 1.0)
        gravity.zero_()
        gravity[:, 1], gravity[:, 2] = -9.81 * np.sin(angle), -9.81 * np.cos(angle)
        e.step(k, env.servo.before_each)
        p = e.t.qpos[:, env.object_q[:3]].float()
        if step == settle:
            place = p.clone()
            inside = (e.t.pair_normal[:, 5:10] > 0).sum(1) >= 2  # held by at least two fingers at the start
        elif step > settle:
            alive &= ((p - place).norm(dim=1) <= LEFT) & ((e.t.flags >> 30) & 1 == 0)
            time_held += alive * dt
        if step == late:
            start = p.clone()
    peaks = e.peaks()
    warp = e.kind == "warp"
    newton, rows = (
        (float(x.numpy().mean()) for x in (e.d.solver_niter, e.d.nefc)) if warp else (float("nan"), float("nan"))
    )
    creep = 1e3 * (p - start).norm(dim=1)[alive & inside] / CREEP_S
    found = _contacts(env)
    seen = max(len(np.unique(found["world"])), 1)

    def part(x, q):
        return float(np.percentile(x, q)) if len(x) else float("nan")

    creep = creep.cpu().numpy()
    return {
        "worlds_judged": int(inside.sum()), "held": float((alive & inside).sum() / inside.sum().clamp(min=1)),
        "hold_s": float(time_held[inside].mean()), "creep_mm_s": part(creep, 50), "creep_p95_mm_s": part(creep, 95),
        "tip_depth_p95_mm": part(found["tip"], 95), "other_depth_p95_mm": part(found["other"], 95),
        "k_ratio": part(found["k"], 50),
        "contacts": len(found["world"]) / seen, "contacts_peak": peaks["contacts"], "rows": rows,
        "rows_peak": peaks["rows"],
        "newton": newton, "worlds_losing_contacts": int(((e.t.overflow & OVERFLOW_BITS) != 0).sum()) if warp else 0,
    }  # fmt: skip


def _speed(env: Any, grasp: tools.Snapshot, steps: int) -> float:
    """Seconds of a control step of physics and servo, from the grasp."""
    times = []
    for _ in range(3):
        grasp.restore(env, fields=True)
        times.append(tools.seconds(env.device, lambda: env.engine.step(env.decimation, env.servo.before_each), steps))
    return float(np.median(times))


COLUMNS = (
    ("steps_per_s", "steps/s", "{:,.0f}"),
    ("held", "held", "{:.1%}"),
    ("hold_s", "hold s", "{:.2f}"),
    ("creep_mm_s", "creep mm/s", "{:.3f}"),
    ("creep_p95_mm_s", "95 %", "{:.2f}"),
    ("tip_depth_p95_mm", "tip depth mm", "{:.2f}"),
    ("other_depth_p95_mm", "other mm", "{:.2f}"),
    ("k_ratio", "K", "{:.3f}"),
    ("contacts", "contacts", "{:.1f}"),
    ("rows", "rows", "{:.0f}"),
    ("newton", "newton", "{:.1f}"),
)


def table(rows: dict[str, dict]) -> str:
    """Markdown."""
    lines = ["| setting | " + " | ".join(c[1] for c in COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, row in rows.items():
        cells = [
            form.format(row[key]) if row.get(key) is not None and np.isfinite(row[key]) else ""
            for key, _, form in COLUMNS
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(rows: dict[str, dict], path: Path, about: str) -> None:
    """A row a setting: throughput, share held, creep."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = list(rows)[::-1]
    fig, axes = plt.subplots(1, 4, figsize=(13, 1.2 + 0.24 * len(names)), sharey=True)
    panels = (
        ("steps_per_s", 1e-3, "thousand steps/s that physics\nand servo allow"),
        ("held", 100.0, "held, palm down (%)"),
        ("creep_mm_s", 1.0, "creep under load (mm/s):\nfilled: median, hollow: 95 %"),
        ("other_depth_p95_mm", 1.0, "penetration, 95 % (mm):\nfilled: fingertips, hollow: all else"),
    )
    for ax, (key, unit, label) in zip(axes, panels, strict=True):
        for y, name in enumerate(names):
            colour = "C3" if name == "chosen" else "C0"
            points = {
                "creep_mm_s": ("creep_mm_s", "creep_p95_mm_s"),
                "other_depth_p95_mm": ("tip_depth_p95_mm", key),
            }.get(key, (key,))
            x = [unit * rows[name][k] for k in points if rows[name].get(k) is not None]
            if x:
                ax.plot(x, [y] * len(x), "-", color=colour, lw=1)
                ax.plot(x[:1], [y], "o", color=colour, ms=5)
                ax.plot(x[1:], [y] * len(x[1:]), "o", color=colour, ms=5, mfc="white")
        ax.set_xlabel(label, fontsize=9)
        ax.grid(alpha=0.3)
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].set_xlim(left=0.0)
    axes[2].set_xscale("log")
    fig.suptitle(about, fontsize=9)
    fig.tight_layout()
    fig.savefig(path, dpi=100)
    plt.close(fig)


def write(result: dict, out: Path) -> None:
    """physics.json, physics.md and physics.png."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "physics.json").write_text(json.dumps(result, indent=1))
    (out / "physics.md").write_text(table(result["rows"]) + "\n")
    figure(result["rows"], out / "physics.png", f"{result['device']}, {result['engine']}, {result['worlds']} worlds")


def join(files: str, out: Path) -> dict:
    """One result of several, in the order of SETTINGS; the machine is that of the first."""
    parts = [json.loads(Path(f).read_text()) for f in files.split(",")]
    rows = {name: row for part in parts[::-1] for name, row in part["rows"].items()}
    result = {**parts[0], "rows": {name: rows[name] for name in SETTINGS if name in rows}}
    write(result, out)
    print(table(result["rows"]))
    return result


def main(argv: list[str]) -> dict:
    own, rest = tools.split(
        argv,
        {
            "only": "",
            "minutes": "20",
            "out": "out/physics",
            "steps": "",
            "join": "",
            "policy": str(tools.ROOT / "checkpoints" / "grasp.pt"),
        },
    )
    if own["join"]:
        return join(own["join"], Path(own["out"]))
    cfg = tools.config(rest)
    device = cfg["device"]
    names = [n.strip() for n in own["only"].split(",")] if own["only"] else list(SETTINGS)
    for n in names:
        if n not in SETTINGS:
            raise UserError(f"benchmarks.physics: only={n}: no such setting; there are: {', '.join(SETTINGS)}")
    steps = tools.numbers(own["steps"] or ("30" if device.startswith("cuda") else "10"), "steps")[0]
    until = time.monotonic() + 60 * float(own["minutes"])
    out = Path(own["out"])
    env, grasp = _grasp(cfg, own["policy"])
    stiffness = env.objects.stiffness.clone()
    rows: dict[str, dict] = {}
    result: dict = {"benchmark": "physics", **tools.about(device), "engine": env.engine.kind, "worlds": env.num_envs}
    for name in names:
        if time.monotonic() > until:
            print(f"  minutes={own['minutes']} are over; not measured: {', '.join(names[len(rows) :])}")
            break
        begin = time.monotonic()
        setting = SETTINGS[name]
        if setting.sim or setting.edit:
            env = None
            gc.collect()
            with edited(setting.edit):
                env = make_env(
                    {**cfg, "sim": {**cfg["sim"], **setting.sim}}, cfg["worlds"], device, 0, cfg["sim"]["engine"]
                )
        with torch.no_grad():
            seconds = _speed(env, grasp, steps)
            row = {
                "steps_per_s": env.num_envs / seconds,
                "control_step_ms": 1e3 * seconds,
                **_hold(env, grasp, stiffness),
            }
        rows[name] = {k: None if v != v else float(f"{v:.5g}") for k, v in row.items()}
        rows[name]["measured_in_s"] = round(time.monotonic() - begin, 1)
        r = {k: float("nan") if v is None else v for k, v in rows[name].items()}
        print(
            f"  {name:36s} {r['steps_per_s']:9.0f} steps/s  held {r['held']:.3f}  creep {r['creep_mm_s']:.3f} mm/s"
            f" (95 %: {r['creep_p95_mm_s']:.2f})  "
            f"tip {r['tip_depth_p95_mm']:.2f} mm  K {r['k_ratio']:.3f}  ({r['measured_in_s']:.0f} s)",
            flush=True,
        )
        result["rows"] = rows
        write(result, out)
    print(json.dumps(result), flush=True)
    return result


if __name__ == "__main__":
    tools.command(main, __doc__)
