"""``--help`` of train and play, written from the config files themselves so that it cannot go stale."""

from __future__ import annotations

from pathlib import Path

from dexsim.cli.settings import groups
from dexsim.console import program

TRAIN = """usage: dexsim train [key=value ...]

Train a policy in many simulated worlds at once. Ctrl-C stops and saves.

examples:
  dexsim train task=grasp                                the whole job, sized for this machine
  dexsim train device=cpu iterations=180                 a first look that learns: five minutes on two cores
  dexsim train servo=ideal agent.algorithm.learning_rate=5e-4
  dexsim train resume=runs/grasp/<run>/last.pt iterations=2000
  dexsim train --multirun seed=1,2,3 servo=xhand,ideal   every combination, one run each (docs/howto/gpus.md)
  torchrun --nproc_per_node=8 -m dexsim train task=grasp    eight GPUs, worlds= for each (docs/howto/gpus.md)
"""
PLAY = """usage: dexsim play checkpoint=PATH [key=value ...]
       dexsim play policy=random|zero|scripted task=grasp [key=value ...]

Play a policy: a metrics table, metrics.json, plots and, unless video=false, an mp4.

examples:
  dexsim play checkpoint=checkpoints/grasp.pt
  dexsim play checkpoint=runs/grasp/<run>/last.pt episodes=1024 seed=7 video=false
  dexsim play checkpoint=checkpoints/grasp.pt servo=ideal          change its own config
  dexsim play policy=random task=grasp tactile=raw record=a.mcap realistic=true
  dexsim play checkpoint=checkpoints/grasp.pt view=true            live in a browser
  dexsim play replay=a.mcap                                        recorded against simulated: plots, video
  dexsim play replay=rig.mcap model=rig.xml servo=rig.yaml remap./joint_states=/rig/states meta.effort_is=current_A
"""
REPLAY = """with replay=FILE.mcap, beside out= and video=:
  model=                      the recorded machine, MJCF or URDF; hand=, hand_mirror=true: one that training knows
  servo=                      its drives: servo.yaml of a diagnosis (servo_file= is the same), or one of servo= below
  object=                     what was held, where its pose was recorded: box, sphere, ... (a wrong one lists them)
  object_size=                its extents, m: three of a box, diameter and length of a capsule, the longest of others
  object_mass=                kg
  object_friction=            sliding, of hand and object
  hold=recorded               joints without a servo, or that its file was not fitted to, follow their recording;
                              limp: nothing holds those without a servo
  start= end=                 part of the recording, s; all of it by default
  timestep=                   a physics step, s
  remap.OURS=THEIRS           a topic or a joint of the file; meta.KEY=VALUE what the file does not say
"""
END = """
  dexsim {script} --cfg      every setting, those in groups too (task.rewards.force, ...), with its value, then stop
"""


def text(script: str, config_dir: Path) -> str:
    """Return the help page of ``train`` or ``play``."""
    files = ["config.yaml"] if script == "train" else ["play.yaml"]
    lines = [TRAIN if script == "train" else PLAY, "settings (key=default):"]
    for file in files:
        lines += [f"  {f'{key}={value}':<28}{comment}" for key, value, comment in program.settings(config_dir / file)]
    lines += ["", *([REPLAY] if script == "play" else []), "groups (one file of dexsim/configs/<group>/ each):"]
    lines += [f"  {name + '=':<14}{' | '.join(options)}" for name, options in groups(config_dir).items()]
    return program.words("\n".join(lines) + "\n" + END.format(script=script))
