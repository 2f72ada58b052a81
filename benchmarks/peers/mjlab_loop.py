"""The environment loop of mjlab 1.6 on the written scene. Needs mjlab and no dexsim:

    python mjlab_loop.py SCENE_FOLDER WORLDS DEVICE

A small environment as its manipulation tasks are made: joint position action, joint and box observations, three
rewards, two terminations.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import mujoco
import torch
from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg


def box_pose(env):
    """Position and quaternion of the box [N, 7], without the world's offset."""
    data = env.scene["box"].data
    return torch.cat([data.root_link_pos_w - env.scene.env_origins, data.root_link_quat_w], dim=-1)


def box_height(env):
    return box_pose(env)[:, 2]


def box_lost(env):
    return box_pose(env)[:, 2] < -0.06


def config(folder: Path, about: dict, worlds: int) -> ManagerBasedRlEnvCfg:
    """The environment's settings."""
    servo, start = about["servo"], dict(zip(about["joints"], about["start"]))
    groups: dict[tuple, list[str]] = {}
    for k, name in enumerate(about["joints"]):
        key = (servo["kp"][k], servo["kd"][k], servo["torque_limit"][k])
        groups.setdefault(key, []).append(name)
    actuators = tuple(BuiltinPositionActuatorCfg(target_names_expr=tuple(names), stiffness=kp, damping=kd,
                                                 effort_limit=limit)
                      for (kp, kd, limit), names in groups.items())
    hand = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_file(str(folder / "hand.xml")),
                     init_state=EntityCfg.InitialStateCfg(joint_pos=start),
                     articulation=EntityArticulationInfoCfg(actuators=actuators), sort_actuators=True)
    pose = about["object_pose"]
    box = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_file(str(folder / "box.xml")),
                    init_state=EntityCfg.InitialStateCfg(pos=tuple(pose[:3]), rot=tuple(pose[3:7])))
    terms = {"joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel),
             "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel),
             "box": ObservationTermCfg(func=box_pose), "actions": ObservationTermCfg(func=mdp.last_action)}
    joints = SceneEntityCfg("hand", joint_names=(".*",))
    for name in ("joint_pos", "joint_vel"):
        terms[name].params = {"asset_cfg": joints}
    sim, spread = about["sim"], about["spread"]
    return ManagerBasedRlEnvCfg(
        decimation=about["decimation"], episode_length_s=8.0, seed=1,
        scene=SceneCfg(num_envs=worlds, env_spacing=0.0, entities={"hand": hand, "box": box}),
        observations={"actor": ObservationGroupCfg(dict(terms)), "critic": ObservationGroupCfg(dict(terms))},
        actions={"joint_pos": JointPositionActionCfg(entity_name="hand", actuator_names=(".*",), scale=1.0,
                                                     use_default_offset=False)},
        events={"reset": EventTermCfg(func=mdp.reset_scene_to_default, mode="reset"),
                "joints": EventTermCfg(func=mdp.reset_joints_by_offset, mode="reset", params={
                    "position_range": (-spread["joint"], spread["joint"]), "velocity_range": (0.0, 0.0),
                    "asset_cfg": joints}),
                "place": EventTermCfg(func=mdp.reset_root_state_uniform, mode="reset", params={
                    "pose_range": {"x": (-spread["xy"], spread["xy"]), "y": (-spread["xy"], spread["xy"]),
                                   "z": (-spread["z"], spread["z"])},
                    "velocity_range": {}, "asset_cfg": SceneEntityCfg("box")})},
        rewards={"height": RewardTermCfg(func=box_height, weight=1.0),
                 "action_rate": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.01),
                 "lost": RewardTermCfg(func=mdp.is_terminated, weight=-1.0)},
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
                      "lost": TerminationTermCfg(func=box_lost)},
        sim=SimulationCfg(nconmax=sim["nconmax"], njmax=sim["njmax"], mujoco=MujocoCfg(
            timestep=sim["timestep"], impratio=sim["impratio"], cone="elliptic", integrator="implicitfast",
            iterations=sim["iterations"],
            ls_iterations=sim["ls_iterations"], disableflags=("multiccd",))))


def main(folder: str, worlds: int, device: str) -> dict:
    """Milliseconds of one environment step of all worlds in the grasp."""
    import importlib.metadata

    about = json.loads((Path(folder) / "scene.json").read_text())
    env = ManagerBasedRlEnv(config(Path(folder), about, worlds), device=device)
    env.reset()
    names = [n.split("/")[-1] for n in env.action_manager.get_term("joint_pos").target_names]

    def action(key: str) -> torch.Tensor:
        by_name = dict(zip(about["joints"], about[key]))
        return torch.tensor([by_name[n] for n in names], device=device).repeat(worlds, 1)

    start_action, closed = action("start"), action("closed")
    for k in range(about["closing"]):
        env.step(start_action if k < 17 else closed)
    sync = torch.cuda.synchronize if device.startswith("cuda") else (lambda: None)
    sync()
    start = time.perf_counter()
    for _ in range(about["timed"]):
        env.step(closed)
    sync()
    seconds = (time.perf_counter() - start) / about["timed"]
    height = box_height(env)
    return {"peer": f"mjlab {importlib.metadata.version('mjlab')}", "worlds": worlds, "ms": 1e3 * seconds,
            "height": float(height.median()),
            "in_hand": float((height > 0.03).float().mean())}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]), sys.argv[3])))
