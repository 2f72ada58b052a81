"""EMPS, a linear drive at 1 kHz (Janot, Gautier, Brunot 2019, nonlinearbenchmark.org): closed loop, force from the
drive's voltage."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from benchmarks.real.common import Converted, rig, save
from dexsim.errors import UserError
from dexsim.gap.search.inverse_dynamics import Stretch, body, motion

KP, KV, FORCE_PER_VOLT = 160.18, 243.45, 35.1507  # 1/s, V/(m/s), N/V: of the benchmark's controller and drive
VOLTS = 10.0
MODEL = """<mujoco model="emps">
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="carriage">
      <joint name="carriage" type="slide" axis="1 0 0"/>
      <geom name="mass" type="box" size="0.1 0.1 0.05" mass="{mass}" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
FILES = {"estimation": "DATA_EMPS.mat", "pulses": "DATA_EMPS_PULSES.mat"}
REFERENCE = {"mass": 95.1089, "viscous": 203.5034, "coulomb": 20.3935, "offset": -3.1648}


def load(data: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return times s, positions m, forces N and targets m of one of FILES."""
    from scipy.io import loadmat

    raw = loadmat(data / FILES[name])
    get = lambda key: np.asarray(raw[key], float).reshape(-1)  # noqa: E731
    return get("t"), get("qm"), float(raw["gtau"].squeeze()) * get("vir"), get("qg")


def stretch(t: np.ndarray, q: np.ndarray, force: np.ndarray, cutoff: float) -> Stretch:
    """Return a recorded motion of the carriage (as of `load`), filtered, beside a body of 95 kg."""
    m = motion(t, q[:, None], force[:, None], cutoff)
    model = mujoco.MjModel.from_xml_string(MODEL.format(mass=95))
    return Stretch(m, body(model, np.zeros(3), ("carriage",), m))


def convert(data: Path, out: Path, mass: float = 95.0) -> Converted:
    """Convert DATA_EMPS.mat and DATA_EMPS_PULSES.mat. mass: believed [kg]; of the friction nothing is."""
    if not (data / "DATA_EMPS.mat").is_file():
        raise UserError(f"{data}: no DATA_EMPS.mat; download the EMPS benchmark from nonlinearbenchmark.org")
    # the law is volts = KV * (KP * error - speed); as a duty of 10 V, of which the drive makes FORCE_PER_VOLT * 10 N
    model, servo = rig(
        out, "emps", MODEL.format(mass=mass),
        {
            "drive": "voltage",
            "loop_rate": 1000,
            "joints": {
                "*": {
                    "kp": KP * KV / VOLTS,
                    "kd": KV / VOLTS,
                    "torque_limit": FORCE_PER_VOLT * VOLTS,
                    "coulomb_friction": "unknown",
                    "viscous_friction": "unknown",
                }
            },
        },
    )  # fmt: skip
    paths = []
    for name, file in FILES.items():
        t, q, force, target = load(data, name)
        paths.append(
            save(
                out / f"{Path(file).stem.lower()}.mcap",
                ("carriage",),
                t,
                target[:, None],
                t,
                q[:, None],
                effort=force[:, None],
                robot="emps",
                gravity="0 0 0",
            )
        )
    return Converted(paths[:1], model, servo, paths[1:])
