"""The hand and a box as plain MJCF, for simulators that do not know dexsim: written from world 0 of a dexsim
environment.

The same bodies, collision shapes, contact parameters, joint friction, armature, solver and time step; in place of
dexsim's servo stand MuJoCo's own position actuators with its nominal gains and torque limits.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from dexsim.actuator.columns import NAMES
from dexsim.actuator.table import ServoTable
from dexsim.assets import xhand
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tasks.env import OBJECT, HandEnv, _solver_options

# One box, dropped with a spread of places and joint angles that all simulators get: worlds that are all alike would all
# need the same few solver iterations, which no training has. The servo is also randomized by world in dexsim; the
# others have none.
SPREAD = {"joint": 0.1, "xy": 0.012, "z": 0.02}  # half widths: rad, m, m
SETTINGS = ("task=grasp", "task.objects.train=[box]", "task.objects.held_out=[tetra]", "task.action.mode=absolute",
            "randomize.object.scale=1.38", "randomize.object.aspect=1.0", "randomize.object.mass=0.1",
            "randomize.object.com=0.0",
            "randomize.object.friction=0.8", "randomize.initial.joint=[-0.1,0.1]",
            "randomize.initial.object_xy=[-0.012,0.012]",
            "randomize.initial.drop=[0.03,0.07]",
            "randomize.initial.velocity_xy=0.0", "randomize.initial.velocity_z=0.0", "randomize.initial.spin=0.0",
            "randomize.initial.tilt=0.0", "randomize.push.weights=0.0")
CLOSE = 0.42  # rad beyond the start pose, every flexing joint
STILL = ("thumb_bend_joint", "index_bend_joint")  # these two turn a finger sideways
CLOSING, TIMED = 50, 60  # control steps: into the grasp, then timed


def targets() -> tuple[np.ndarray, np.ndarray]:
    """Start pose and closed targets [12] (rad): the open hand, and its fingers bent."""
    start = np.array(load_hand("xhand").pose("open"))
    low, high = np.array(xhand.joint_limits()).T
    still = np.isin(xhand.JOINTS, STILL)
    return start, np.clip(np.where(still, start, start + CLOSE), low, high)


def write(env: HandEnv, folder: Path) -> Path:
    """hand.xml (hand and actuators), box.xml, scene.xml (both) and scene.json (poses, settings) into `folder`."""
    hand, e = xhand.hand_spec(), env.engine
    sim = env.cfg["sim"]
    hand.option.timestep = sim["timestep"]
    _solver_options(hand, sim, e.kind)
    d = env.task["contact"]["impedance"]
    for geom in list(hand.geoms):
        if not geom.contype and not geom.conaffinity:
            hand.delete(geom)
    ids = {e.mjm.geom(g).name: g for g in range(e.mjm.ngeom)}
    friction, solref = (e.field(k)[0].cpu().numpy() for k in ("geom_friction", "geom_solref"))
    for k, geom in enumerate(hand.geoms):
        g = ids[geom.name] if geom.name else k
        geom.friction, geom.solref = friction[g], solref[g]
        if geom.name in xhand.TIP_GEOMS:
            geom.solimp = [d, d, 1e-3, 0.5, 2.0]
    table = ServoTable.from_dict(env.cfg["servo"]).nominal(xhand.JOINTS)
    nominal = {name: table[:, NAMES.index(name)] for name in ("kp", "kd", "torque_limit", "coulomb_friction")}
    for k, name in enumerate(xhand.JOINTS):
        joint = hand.joint(name)
        joint.frictionloss = float(nominal["coulomb_friction"][k])
        joint.solimp_friction, joint.solref_friction = [0.97, 0.99, 1e-3, 0.5, 2.0], [0.02, 1.0]
    both = hand.copy()
    size, pose = env.objects.size[0].cpu().numpy(), env.object_pose[0].cpu().numpy()
    pose[:3] = [*env.centre0.flatten()[:2].tolist(), float(env.objects.radius[0]) + 0.05]
    g = ids["object_box"]
    box = mujoco.MjSpec()
    for spec in (box, both):
        body = spec.worldbody.add_body(name=OBJECT, pos=pose[:3], quat=pose[3:7])
        body.add_freejoint(name="object_free")
        body.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=size, mass=0.1, condim=4, contype=1,
                      conaffinity=2, friction=friction[g],
                      solref=solref[g])
    folder.mkdir(parents=True, exist_ok=True)
    for name, spec in (("hand", hand), ("box", box), ("scene", both)):
        spec.compile()
        (folder / f"{name}.xml").write_text(_plain(spec, nominal if name == "scene" else None))
    start, closed = targets()
    about = {"joints": list(xhand.JOINTS), "start": start.tolist(), "closed": closed.tolist(),
             "object_pose": pose.tolist(), "decimation": env.decimation,
             "closing": CLOSING, "timed": TIMED, "spread": SPREAD,
             "sim": {k: sim[k] for k in ("timestep", "impratio", "iterations", "ls_iterations", "nconmax", "njmax")},
             "servo": {k: v.tolist() for k, v in nominal.items()}}
    (folder / "scene.json").write_text(json.dumps(about, indent=1))
    return folder


def _plain(spec: mujoco.MjSpec, servo: dict[str, np.ndarray] | None) -> str:
    """MJCF that older MuJoCo reads as well: vertices in the file itself; position actuators written as such."""
    root = ElementTree.fromstring(spec.to_xml())
    for mesh in root.iter("mesh"):
        if file := mesh.attrib.pop("file", None):
            lines = (x.split() for x in (xhand.FOLDER / "meshes" / Path(file).name).read_text().splitlines())
            mesh.set("vertex", " ".join(v for x in lines if x and x[0] == "v" for v in x[1:4]))
    if servo is not None:
        group = ElementTree.SubElement(root, "actuator")
        for k, name in enumerate(xhand.JOINTS):
            limit = float(servo["torque_limit"][k])
            ElementTree.SubElement(group, "position", name=name, joint=name, kp=f"{servo['kp'][k]:g}",
                                   kv=f"{servo['kd'][k]:g}",
                                   forcerange=f"{-limit} {limit}")
    return ElementTree.tostring(root, encoding="unicode")


def main(folder: str) -> None:
    """Write the scene (a dexsim environment of one world is built for it)."""
    from dexsim.cli import start as start_up
    from dexsim.tasks import make_env

    cfg = start_up.for_train([*SETTINGS, "device=cpu", "worlds=1"], CONFIGS).cfg
    write(make_env(cfg, 1, "cpu", 0, "mujoco"), Path(folder))


if __name__ == "__main__":
    main(sys.argv[1])
