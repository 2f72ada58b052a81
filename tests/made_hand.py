"""A small hand of primitives for tests: three fingers, nine joints, a left one, its thumb last; one finger closes with
negative angles; the root stands anywhere in the world. Nothing about it is like the xHand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

RADIUS, PROXIMAL, DISTAL = 0.009, 0.045, 0.034

_FINGER = """
      <body name="{n}_base" pos="{x} 0.042 0.002">
        <inertial pos="0 0.005 0" mass="0.02" diaginertia="4e-6 4e-6 4e-6"/>
        <joint name="{n}_spread" axis="0 0 1" range="-0.3 0.3"/>
        <body name="{n}_link">
          <inertial pos="0 0.022 0" mass="0.03" diaginertia="8e-6 4e-6 8e-6"/>
          <joint name="{n}_curl" axis="{s}1 0 0" range="{range}"/>
          <geom type="capsule" fromto="0 0.016 0 0 0.036 0" size="0.008"/>
          <body name="{n}_end" pos="0 0.045 0">
            <inertial pos="0 0.017 0" mass="0.015" diaginertia="4e-6 2e-6 4e-6"/>
            <joint name="{n}_bend" axis="{s}1 0 0" range="{range}"/>
            <geom type="capsule" fromto="0 0.012 0 0 0.025 0" size="0.009"/>
            <geom class="seen" type="sphere" pos="0 0.03 0" size="0.004"/>
          </body>
        </body>
      </body>"""

_MODEL = """<mujoco model="made">
  <compiler angle="radian"/>
  <default>
    <joint armature="4e-4" damping="0.01"/>
    <default class="seen"><geom contype="0" conaffinity="0" mass="0"/></default>
  </default>
  <worldbody>
    <light pos="0 0 1"/>
    <body name="hull" pos="0.3 -0.2 0.5" quat="0.8 0.2 -0.4 0.4">
      <inertial pos="0 0 -0.01" mass="0.4" diaginertia="4e-4 4e-4 4e-4"/>
      <geom type="box" size="0.038 0.042 0.01" pos="0 0 -0.008"/>{fingers}
      <body name="t_base" pos="-0.036 0.012 0.002">
        <inertial pos="0 0 0.005" mass="0.02" diaginertia="4e-6 4e-6 4e-6"/>
        <joint name="t_swing" axis="0 1 0" range="-0.6 0.8"/>
        <body name="t_link">
          <inertial pos="0 0 0.022" mass="0.03" diaginertia="8e-6 8e-6 4e-6"/>
          <joint name="t_curl" axis="0 1 0" range="-0.2 1.5"/>
          <geom type="capsule" fromto="0 0 0.016 0 0 0.036" size="0.008"/>
          <body name="t_end" pos="0 0 0.045">
            <inertial pos="0 0 0.017" mass="0.015" diaginertia="4e-6 4e-6 2e-6"/>
            <joint name="t_bend" axis="0 1 0" range="0 1.6"/>
            <geom name="t_tip" type="capsule" fromto="0 0 0.012 0 0 0.025" size="0.009"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="a_curl" kp="1"/></actuator>
</mujoco>
"""


def taxels(axis: str) -> str:
    """Return a pad's CSV: 4 columns of 5 taxels on the palmar half of the end's capsule, along y (normal +z) or z
    (+x)."""
    rows = ["x,y,z,nx,ny,nz,area"]
    for angle in np.radians([-45.0, -15.0, 15.0, 45.0]):
        for along in np.linspace(0.012, 0.025, 5):
            n = np.array([np.sin(angle), 0.0, np.cos(angle)])
            p = RADIUS * n + [0.0, along, 0.0]
            if axis == "z":  # y -> z -> x -> y
                n, p = n[[2, 0, 1]], p[[2, 0, 1]]
            rows.append(",".join(f"{v:.9f}" for v in (*p, *n, 1.3e-5)))
    return "\n".join(rows) + "\n"


def content(pads: bool = True) -> dict:
    """Return what its hand.yaml says."""
    pad = {"taxels": "finger.csv", "kind": "finger", "rows": 5}
    fingers = [
        {
            "name": n,
            "joints": [f"{n}_spread", f"{n}_curl", f"{n}_bend"],
            "flexion": [f"{n}_curl", f"{n}_bend"],
            "closes": [sign, sign],
            "tip": {"body": f"{n}_end", "position": [0.0, DISTAL, 0.0], "normal": [0.0, 0.0, 1.0]},
            "pad": dict(pad) if pads else None,
        }
        for n, sign in (("a", 1), ("b", -1))
    ]
    thumb = {
        "name": "t",
        "joints": ["t_swing", "t_curl", "t_bend"],
        "flexion": ["t_curl", "t_bend"],
        "tip": {"body": "t_end", "position": [0.0, 0.0, DISTAL], "normal": [1.0, 0.0, 0.0], "geoms": ["t_tip"]},
        "pad": dict(pad, taxels="thumb.csv") if pads else None,
    }
    names = [j for f in (*fingers, thumb) for j in f["joints"]]
    wire = [names[k] for k in (6, 7, 8, 0, 3, 1, 4, 2, 5)]  # not the model's order
    opened = dict(zip(names, (0.0, 0.3, 0.3, 0.0, -0.3, -0.3, -0.4, 0.1, 0.1), strict=True))
    cupped = dict(zip(names, (0.0, 0.8, 1.8, 0.0, -0.8, -1.8, 0.0, 0.45, 0.8), strict=True))
    return {
        "format": "dexsim-hand", "version": 1, "name": "made", "handedness": "left", "model": "made.xml",
        "servo": "servo.yaml",
        "joints": [{"name": j, "effort": 0.5, "speed": 8.0} for j in wire],
        "palm": {"body": "hull", "position": [0.0, 0.0, 0.002], "forward": [0.0, 1.0, 0.0], "normal": [0.0, 0.0, 2.0]},
        "fingers": [*fingers, thumb], "opposing": ["t"],
        "poses": {"open": opened, "cupped": cupped}, "span": 0.08,
        "places": {"catch": [0.026, -0.004, 0.0]},
        "guessed": ["palm.normal"],
    }  # fmt: skip


def made_hand(folder: Path, pads: bool = True, model: str | None = None, **changed: object) -> Path:
    """Write the hand's folder; `changed` replaces fields of hand.yaml. Returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = (("a", 0.022, "", "0 2.1"), ("b", -0.012, "-", "-2.1 0"))
    fingers = "".join(_FINGER.format(n=n, x=x, s=sign, range=span) for n, x, sign, span in parts)
    (folder / "made.xml").write_text((model or _MODEL).replace("{fingers}", fingers), encoding="ascii")
    servo = {"joints": {"*": {"kp": 2.0, "kd": 0.05, "torque_limit": 0.5, "no_load_speed": 8.0, "delay": 0.01}}}
    (folder / "servo.yaml").write_text(yaml.safe_dump(servo), encoding="ascii")
    if pads:
        (folder / "finger.csv").write_text(taxels("y"), encoding="ascii")
        (folder / "thumb.csv").write_text(taxels("z"), encoding="ascii")
    data = content(pads) | changed
    (folder / "hand.yaml").write_text(yaml.safe_dump(data, sort_keys=False), encoding="ascii")
    return folder
