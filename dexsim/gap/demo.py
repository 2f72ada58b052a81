"""A recording with a hidden effect, from our own simulator: what `diagnose.py demo=true` finds again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.catalogue import CATALOGUE, EFFECTS
from dexsim.gap.effects.friction import StribeckFriction
from dexsim.recording import write
from dexsim.recording.mechanism import drive, mechanism, recorded
from dexsim.recording.realistic import Hardware, realistic
from dexsim.recording.schema import COMMANDS, Series

DRAWN = """<geom name="base" type="box" size="0.016 0.022 0.012" pos="0 0 0.016"
 contype="0" conaffinity="0" mass="0" group="2"/>"""
LINK = """<geom name="link" type="capsule" size="0.009" fromto="0 0 -0.012 0 0 -0.088"
 contype="0" conaffinity="0" mass="0" group="2"/>"""
# MuJoCo's dry friction brakes along an exponential of solreffriction's time constant: at its default of 20 ms it turns
# against
# the motion before a fast reversal, which no drive does
MODEL = """<mujoco model="pendulum">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="link">
      <joint name="joint" type="hinge" axis="0 1 0" armature="4e-4" range="-2.5 2.5"
             solimpfriction="0.999 0.9999 0.001 0.5 2" solreffriction="0.002 1"/>
      <geom name="bob" type="sphere" size="0.012" pos="0 0 -0.1" mass="0.15" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
BELIEVED = {
    "drive": "torque",
    "joints": {
        "*": {
            "kp": 2.0,
            "kd": 0.04,
            "torque_limit": 0.8,
            "no_load_speed": 12.0,
            "coulomb_friction": 0.015,
            "viscous_friction": 0.004,
        }
    },
    "loop_rate": 1000,
}
HIDDEN = {e.id: e.demo for e in CATALOGUE if e.demo}


def commands(kind: int, seconds: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times [K] and targets [K] of one of four motions."""
    t = np.arange(0.0, seconds, 0.01)
    if kind == 0:
        return t, 0.8 * np.sin(2 * np.pi * 0.3 * t) + 0.3 * np.sin(2 * np.pi * 1.1 * t)
    if kind == 1:
        knots = np.arange(0.0, seconds + 1.5, 1.2)
        return t, np.interp(t, knots, np.r_[0.0, rng.uniform(-1.2, 1.2, len(knots) - 1)])
    if kind == 2:
        return t, 0.9 * np.sin(2 * np.pi * 0.25 * t) * (0.4 + 0.6 * np.sin(2 * np.pi * 0.11 * t + rng.uniform(0, 1)))
    f = 0.2 + 2.3 * t / seconds
    return t, 0.4 * np.sin(2 * np.pi * np.cumsum(f) * 0.01)


def make(
    folder: Path, effect: str = StribeckFriction.id, seed: int = 0, seconds: float = 6.0, joint: str = "joint"
) -> tuple[list[Path], Path, Path, dict]:
    """Writes four recordings of one joint that hides an effect of HIDDEN (another name: nothing), the model and the
    believed servo; returns their paths and the hidden columns."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    model, servo = folder / "rig.xml", folder / "rig.yaml"
    drawn = (
        MODEL.replace("<worldbody>", f"<worldbody>{DRAWN}")
        .replace('name="joint"', f'name="{joint}"')
        .replace('<geom name="bob"', f'{LINK}<geom name="bob"')
    )
    model.write_text(drawn, encoding="utf-8")
    believed = BELIEVED | ({"loop_encoder": "motor"} if effect in EFFECTS and EFFECTS[effect].parts_motor else {})
    servo.write_text(yaml.safe_dump(believed, sort_keys=False), encoding="utf-8")
    true = yaml.safe_load(yaml.safe_dump(believed))
    # as real machines are: a little off
    for name in ("kp", "kd", "torque_limit", "coulomb_friction", "viscous_friction"):
        true["joints"]["*"][name] *= 1 + 0.03 * rng.uniform(-1, 1)
    hidden = HIDDEN.get(effect, {})
    true["joints"]["*"] |= hidden
    m = mechanism(model, true)
    m.table = ServoTable.from_dict(true)
    paths = []
    for k in range(4):
        t, value = commands(k, seconds, rng)
        series = Series(t, value[:, None], COMMANDS, t.copy())
        run = drive(m, series, [joint], seconds, timestep=0.001)
        recording = realistic(recorded(run, m, series, [joint]), seed=seed * 10 + k, hardware=Hardware())
        recording.meta["servo"] = ""  # what is hidden is not told
        path = folder / f"motion_{k + 1}.mcap"
        write(path, recording)
        paths.append(path)
    return paths, model, servo, hidden
