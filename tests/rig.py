"""A one-joint mechanism: the smallest thing that the whole chain (servo, engine, recording, diagnosis) must handle."""

from __future__ import annotations

import mujoco


def pendulum_spec(
    mass: float = 0.1, length: float = 0.1, armature: float = 1e-4, timestep: float = 0.005
) -> mujoco.MjSpec:
    """Return a point-like mass [kg] at `length` [m] on a hinge `joint` about y, hanging at q = 0; gravity along -z.

    About the hinge the inertia is mass * length^2 + 2/5 mass r^2 (r = 5 mm) + armature [kg.m^2]; positive q swings the
    mass toward -x, and the gravity torque is -mass g length sin(q).
    """
    return mujoco.MjSpec.from_string(f"""
<mujoco model="pendulum">
  <option timestep="{timestep}" integrator="implicitfast"/>
  <worldbody>
    <body name="link">
      <joint name="joint" type="hinge" axis="0 1 0" armature="{armature}"/>
      <geom name="bob" type="sphere" size="0.005" pos="0 0 {-length}" mass="{mass}" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>""")
