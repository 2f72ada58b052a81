"""Another world to be judged in: `python play.py checkpoint=... reality=bench`.

A policy can only be as good as the world it is judged in is different from the one it was trained in.
`dexsim/configs/reality/` holds worlds that no training sees (`train.py` refuses them): C MuJoCo with its own step,
cone, solver and contact softness; one hand whose drives have effects that no randomization contains; encoders and
currents in whole counts, touch in counts and late; control periods that vary and targets that are late or lost. It
stands in for hardware: it is not hardware, and what it leaves out (soft pads, bending, cables) stays unjudged.

The numbers of a file are drawn once: `python -m dexsim.tasks.reality seed=N out=FILE.yaml`; the file says its seed.
The ranges below are ours.
"""

from __future__ import annotations

import copy
import math
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import yaml

from dexsim import typed
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.tasks.servos import RELATIVE

CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
KEYS = {"name", "seed", "sim", "solver", "contact", "servo", "sensors", "timing", "tactile", "tasks"}


def present(cfg: dict[str, Any]) -> bool:
    """Return whether a resolved config asks for another world."""
    return (cfg.get("reality") or {}).get("name", "none") != "none"


def overlay(cfg: dict[str, Any]) -> dict[str, Any]:
    """Return the config with the world of `cfg["reality"]` laid over it: physics, servo, touch, and what its task
    draws.

    The world's servo replaces the policy's belief; its ranges replace those of training, name by name; drives are not
    randomized (it is one hand). Of a task that the world's file does not list, the ranges of training stay. What was
    believed before is kept under "belief". Raises UserError for a file with other keys.
    """
    world, cfg = cfg["reality"], copy.deepcopy(cfg)
    for key in world:
        if key not in KEYS:
            raise UserError(f"reality.{key}: unknown; a file of dexsim/configs/reality has {', '.join(sorted(KEYS))}")
    cfg["sim"].update(world["sim"], engine="mujoco")
    cfg["belief"] = {"servo": cfg["servo"], "drive": math.prod(_middle(cfg, c) for c in ("efficiency", "torque_limit"))}
    cfg["servo"] = world["servo"]
    cfg["tactile"].pop("pads", None)  # what training believes of its own hand's fingertips
    cfg["tactile"].update(world["tactile"])
    cfg["randomize"]["servo"] = {name: 1.0 if name in RELATIVE else 0.0 for name in cfg["randomize"]["servo"]}
    own = world["tasks"].get(cfg["task"]["name"], {})
    for part, over in (("randomize", cfg["randomize"]), ("sensors", cfg["task"].get("sensors", {}))):
        for name, value in own.get(part, {}).items():
            node, *rest = name.split(".") if part == "randomize" else (name,)
            if rest:
                over.setdefault(node, {})[rest[0]] = value
            else:
                over[node] = value
    return cfg


def _middle(cfg: dict[str, Any], column: str) -> float:
    """Return middle of the training's range of a drive's factor."""
    value = cfg["randomize"]["servo"].get(column, 1.0)
    value = value["log"] if isinstance(value, dict) else value
    return float(np.mean(value))


class Reality:
    """What of another world is no setting of the training's: contacts, solver, sensor counts, timing.

    cfg: a file of dexsim/configs/reality. The environment calls `change_model` before it compiles, and at each control
    step `substeps`, `late` and `read`. Runs on the CPU.
    """

    def __init__(self, cfg: dict[str, Any], rng: torch.Generator, hand: Hand):
        self.cfg, self.rng, self.hand = cfg, rng, hand
        given = len(cfg["contact"]["friction_by_finger"])
        if given != len(hand.fingers):
            raise UserError(
                f"reality={cfg['name']}: its friction_by_finger is of {given} fingers, hand={hand.name} has"
                f" {len(hand.fingers)}; draw one for this hand: python -m dexsim.tasks.reality"
            )
        self.last: torch.Tensor | None = None
        for key, known in (("cone", CONES), ("solver", SOLVERS)):
            if cfg["solver"][key] not in known:
                raise UserError(f"reality.solver.{key}={cfg['solver'][key]}: must be {' or '.join(known)}")

    def change_model(self, spec: mujoco.MjSpec) -> None:
        """Change solver, contact softness, torsional and rolling friction, friction by finger (relative to the
        world's)."""
        c, o = self.cfg["contact"], spec.option
        o.cone, o.solver = CONES[self.cfg["solver"]["cone"]], SOLVERS[self.cfg["solver"]["solver"]]
        o.tolerance = self.cfg["solver"]["tolerance"]
        for geom in spec.geoms:
            if geom.name in self.hand.tip_geoms:
                geom.solimp = c["tip_solimp"]
                geom.condim = 6
                geom.friction = [geom.friction[0], c["torsional"], c["rolling"]]
            elif geom.contype or geom.conaffinity:
                geom.solref = c["hand_solref"]

    def friction_factor(self, model: mujoco.MjModel, geoms: list[int]) -> torch.Tensor:
        """Return friction of each hand geom over the world's, [G]: by finger, 1 elsewhere."""
        shares = self.cfg["contact"]["friction_by_finger"]
        by = {g: x for f, x in zip(self.hand.fingers, shares, strict=True) for g in f.geoms}
        return torch.tensor([by.get(model.geom(g).name, 1.0) for g in geoms])

    def substeps(self, nominal: int) -> int:
        """Return physics steps of this control period: nominal, give or take `timing.jitter` of it, the same on
        average."""
        spread = int(round(self.cfg["timing"]["jitter"] * nominal))
        return nominal + int(torch.randint(-spread, spread + 1, (), generator=self.rng)) if spread else nominal

    def late(self, n: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (seconds [N] by which the target of this step is sent late, [N] whether it arrives at all)."""
        t = self.cfg["timing"]
        return t["late"] * torch.rand(n, generator=self.rng), torch.rand(n, generator=self.rng) >= t["lost"]

    def read(self, env: Any) -> None:
        """Replace the environment's joint angles, speeds and torques by what encoders and currents report in counts."""
        s = self.cfg["sensors"]
        step = 2 * math.pi / 2 ** s["encoder_bits"]
        fresh = (env.episode_length_buf <= 1)[:, None]
        angle = torch.round(env.servo.position().float() / step) * step
        last = angle if self.last is None else torch.where(fresh, angle, self.last)
        env.q.copy_(torch.where(env.nan[:, None], env.q, angle))
        env.qd.copy_((env.q - last) / env.dt)
        self.last = env.q.clone()
        env.torque.copy_(torch.round(env.torque * s["torque_scale"] / s["torque_step"]) * s["torque_step"])


def draw(seed: int, servo: dict[str, Any], hand: Hand | None = None) -> dict[str, Any]:
    """Return the numbers of another world, all from one seed. servo: the nominal table (the hand's servo file);
    hand: whose (the xHand)."""
    hand = hand or load_hand("xhand")
    rng = np.random.default_rng(seed)

    def u(low: float, high: float, digits: int = 4) -> float:
        return float(f"{rng.uniform(low, high):.{digits}g}")

    joints = {}
    for joint in hand.joints:
        base = servo["joints"]["*"] | servo["joints"].get(joint, {})
        dry = base["coulomb_friction"] * rng.uniform(1.0, 2.2)
        joints[joint] = {
            "kp": float(f"{base['kp'] * rng.uniform(0.7, 1.2):.4g}"),
            "kd": float(f"{base['kd'] * rng.uniform(0.6, 1.4):.4g}"),
            "torque_limit": float(f"{base['torque_limit'] * rng.uniform(0.8, 1.0):.4g}"),
            "no_load_speed": float(f"{base['no_load_speed'] * rng.uniform(0.75, 1.0):.4g}"),
            "efficiency": u(0.75, 0.95), "deadband": u(0.002, 0.01), "delay": u(0.012, 0.025), "lag": u(0.003, 0.012),
            "coulomb_friction": float(f"{dry:.4g}"), "friction_asymmetry": u(-0.4, 0.4),
            "stribeck_peak": float(f"{dry * rng.uniform(0.5, 1.5):.4g}"), "stribeck_speed": u(0.05, 0.3),
            "load_friction": u(0.03, 0.12), "load_friction_backdriven": u(0.05, 0.2),
            "torque_ripple": float(f"{base['torque_limit'] * rng.uniform(0.005, 0.02):.4g}"),
            "ripple_per_turn": float(rng.integers(8, 30)), "ripple_phase": u(-3.0, 3.0),
            "position_offset": u(-0.03, 0.03), "position_scale": u(0.985, 1.015),
        }  # fmt: skip
    from dexsim.tasks import registry

    tasks = {name: registry.load(where) for name, where in reversed(registry.built_in().items())}
    friction = u(0.6, 0.9)
    size = u(0.049, 0.054, 3)
    return {
        "name": "bench", "seed": seed,
        "sim": {"timestep": 0.003, "iterations": 60, "ls_iterations": 40, "impratio": u(2.0, 4.0, 3),
                "noslip_iterations": 0},
        "solver": {"cone": "elliptic", "solver": "cg", "tolerance": 1e-7},
        "contact": {
            "tip_solimp": [u(0.85, 0.92), u(0.975, 0.99), u(0.0008, 0.002), 0.5, 2.0],
            "hand_solref": [u(0.008, 0.015), u(0.8, 1.2)],
            "torsional": u(0.002, 0.006), "rolling": u(5e-5, 3e-4),
            "friction_by_finger": [u(0.8, 1.15) for _ in hand.fingers],
        },
        "servo": {"drive": "torque", "joints": joints, "current_per_torque": "unknown", "loop_encoder": "joint",
                  "position_encoder": "joint"},
        "sensors": {"encoder_bits": 12, "torque_step": 0.01, "torque_scale": u(0.85, 1.15)},
        "timing": {"jitter": 0.15, "late": 0.006, "lost": 0.01},
        "tactile": {
            "feel_others": True, "stiffness_scale": u(0.7, 1.3), "threshold": u(0.03, 0.07), "noise": u(0.005, 0.015),
            "gain_spread": u(0.1, 0.25),
            "dead": u(0.01, 0.04), "lsb": 0.1, "delay": u(0.015, 0.03), "hysteresis": u(0.1, 0.3),
            "hysteresis_time": u(0.05, 0.4),
        },
        "tasks": {name: own for name, made in tasks.items() if (own := made.another_world(u, friction, size))},
    }  # fmt: skip


HEAD = """\
# Another world to be judged in (`python play.py checkpoint=... reality={name}`): never trained in, standing in for
# hardware. Drawn once, not tuned: python -m dexsim.tasks.reality seed={seed} out=dexsim/configs/reality/{name}.yaml
"""


def text(world: dict[str, Any]) -> str:
    """Return the file of a drawn world."""
    body = yaml.safe_dump(world, sort_keys=False, width=90, default_flow_style=None)  # soft: lines of up to 120
    return HEAD.format(**world) + body


def main(argv: list[str]) -> int:
    """`seed=N out=PATH`: draw a world and write its file."""
    own = {"seed": "20261121", "out": "", "hand": "xhand"}
    own |= typed.settings(argv, own)
    seed = typed.whole("seed", own["seed"])
    if not own["out"]:
        raise UserError("out=PATH: say where to write the world, e.g. out=dexsim/configs/reality/bench.yaml")
    hand = load_hand(own["hand"])
    servo = yaml.safe_load(hand.servo_path.read_text(encoding="utf-8"))
    out = Path(own["out"]).expanduser()
    world = draw(seed, servo, hand)
    world["name"] = out.stem
    out.write_text(text(world), encoding="utf-8")
    print(f"world    {out}")
    return 0


if __name__ == "__main__":
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:], __doc__))
