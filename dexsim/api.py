"""The functions behind `import dexsim`: each does what a command does, from Python, and returns what it found.

Settings are written as on the command line, "key=value" (`dexsim train --help` lists them), so that whatever works
there works here. What a user got wrong raises `dexsim.UserError`, one line that names it. Quantities are in SI units,
joints in the order of the recording or the environment.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexsim.errors import UserError
from dexsim.paths import CONFIGS

if TYPE_CHECKING:
    import torch

    from dexsim.agents import PPO, Distillation
    from dexsim.gap.inquiry import Diagnosis
    from dexsim.recording.schema import Recording
    from dexsim.tasks.task import Task as HandTask

    Task = str | type[HandTask]
    """A task by name, as "module:Class", or its class."""

File = str | Path
Policy = Callable[[Any], "torch.Tensor"]
"""Observations of an environment (a TensorDict) -> actions [N, A]."""


# -- recordings


def read_recording(
    path: File, remap: Mapping[str, str] | None = None, meta: Mapping[str, Any] | None = None,
    joints: Sequence[str] | None = None, audit: bool = True,
) -> Recording:  # fmt: skip
    """Return a recording out of an MCAP file or a ROS 2 bag folder.

    Args:
        remap: our name of a topic or joint -> theirs, {"/joint_states": "/xhand/state"}.
        meta: metadata that the file lacks or has wrong, {"effort_is": "current_A"}.
        joints: the model's joint names, in the order wanted. None: those of the file.
        audit: look for faults of the signals too.

    Returns:
        commands, states (position [T, J] rad, velocity [T, J] rad/s, effort [T, J] A or N.m), touch and more, each with
        its own times [s]; `findings` lists what is lost, assumed or suspicious. Nothing is repaired.

    Raises:
        UserError: no recording there, or the request does not fit it.
    """
    from dexsim.recording import read

    return read(path, remap, meta, joints, audit)


def write_recording(path: File, recording: Recording) -> Path:
    """Write a recording as an MCAP file that `read_recording` and `dexsim diagnose` read; returns its path."""
    from dexsim.recording import write

    path = Path(path).expanduser()
    _folder(path.parent)
    write(path, recording)
    return path


def replay_recording(
    recording: Recording, model: File | None = None, servo: File | None = None, timestep: float = 5e-4
) -> Recording:
    """Return what the simulator makes of a recording's commands, from its first measured position on, without any
    correction.

    Args:
        model: MuJoCo or URDF file of the mechanism; None: the xHand.
        servo: servo.yaml of its drives, a diagnosis' own for instance; None: the xHand's.
        timestep: of the physics [s], 1e-4 to 0.02.

    Returns:
        The simulated recording: the same commands and joints, states 200 times a second, effort in N.m.
    """
    from dexsim.recording import mechanism
    from dexsim.sim.quiet import quiet_warp

    if not 1e-4 <= timestep <= 0.02:
        raise UserError(f"timestep={timestep}: must be a number from 0.0001 to 0.02 s")
    quiet_warp("cpu")
    m = mechanism.for_recording(recording, model, servo)
    recording = mechanism.driven(recording, m)
    run = mechanism.replay(recording, m, timestep)
    return mechanism.recorded(run, m, recording.commands, recording.joints)


def demo_recordings(
    folder: File, effect: str = "command_delay", seed: int = 0
) -> tuple[list[Path], Path, Path, dict[str, float]]:
    """Return four short recordings of one simulated joint that hides an effect, to try things on.

    Args:
        effect: what is hidden; a wrong name is answered with those there are.

    Returns:
        The recordings, the model and the servo.yaml that a user would believe, and what is hidden, {column: value}.
    """
    from dexsim.gap import demo
    from dexsim.sim.quiet import quiet_warp

    if effect not in demo.HIDDEN:
        raise UserError(f"effect={effect}: must be one of {', '.join(sorted(demo.HIDDEN))}")
    quiet_warp("cpu")
    paths, model, servo, hidden = demo.make(_folder(folder), effect, seed=seed)
    return paths, model, servo, hidden


# -- what the simulator leaves out


def diagnose(
    recordings: File | Sequence[File], model: File | None = None, servo: File | None = None,
    out: File = "out/diagnosis", held_out: File | Sequence[File] | None = None, effects: Iterable[str] | None = None,
    seed: int = 0, device: str = "cpu", replay: str = "mujoco", next_recording: bool = True,
    meta: Mapping[str, str] | None = None, remap: Mapping[str, str] | None = None,
    say: Callable[[str], None] | None = None,
) -> Diagnosis:  # fmt: skip
    """Find the physics that the simulator leaves out of recordings; writes what `dexsim diagnose` writes into `out`.

    Args:
        recordings: MCAP files, bag folders or patterns ("runs/*.mcap").
        model: MuJoCo or URDF file; None: the xHand. servo: servo.yaml believed of its drives; None: the xHand's.
        held_out: recordings kept out of the fit; None: a condition or the last quarter of the time is kept out.
        effects: names of the effects to consider; None: all.
        seed: of the bootstraps. device: "cpu", "cuda" or "cuda:1", where hypotheses are simulated.
        replay: engine in which the answer is replayed, "mujoco", "warp" or "none".
        next_recording: also plan the next recording, where one would settle a question.
        meta, remap: as `read_recording`.
        say: takes each line of progress; None: silent.

    Returns:
        `data` is diagnosis.json as a dict ("verdict", "findings" with effect, joint, parameters, intervals,
        confidence); `sentence` says it in one; `out`/servo.yaml trains with it:
        ``train(settings=["servo_file=out/diagnosis/servo.yaml"])``.

    Raises:
        UserError: a file or setting that does not serve. A recording that cannot be used is a verdict, no error.
    """
    from dexsim.gap import command
    from dexsim.gap.diagnosis import diagnose as search
    from dexsim.gap.report.files import save

    if effects is not None and isinstance(effects, str):
        raise UserError(f"effects={effects!r}: must be a list of names, e.g. [{effects!r}]")
    given: dict[str, Any] = {
        "recordings": _texts(recordings), "held_out": None if held_out is None else _texts(held_out),
        "model": None if model is None else str(model), "servo": None if servo is None else str(servo),
        "effects": None if effects is None else list(effects), "seed": seed, "next": next_recording, "replay": replay,
        "meta": dict(meta or {}), "remap": dict(remap or {}),
    }  # fmt: skip
    where = Path(out).expanduser()
    parsed = command.settings_of(given, where, command.started(device))
    command.claim(parsed)
    found = search(parsed, say=say or _silent)
    save(found, where)
    return found


# -- simulated hands and policies


def settings(task: Task = "grasp", overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Return every setting of a training with the value it would have, as a plain nested dict (`dexsim train --cfg`).

    Args:
        overrides: "key=value" each, as on the command line: ["worlds=64", "servo=ideal", "agent.algorithm.gamma=0.98"].
    """
    return dict(_start(task, None, None, None, overrides).cfg)


def make_env(
    task: Task = "grasp", worlds: int | None = None, device: str | None = None, seed: int = 1,
    settings: Sequence[str] = (), checkpoint: File | None = None, *, hand: File | None = None,
    servo: File | None = None, objects: Sequence[File] | None = None, kept_out: Sequence[File] | None = None,
    rewards: Mapping[str, float] | None = None,
) -> HandTask:  # fmt: skip
    """Simulate many hands at one task: an rsl-rl VecEnv (`dexsim.learning.gym_env.GymVectorEnv` makes it
    gymnasium's).

    Args:
        task: a name (`dexsim tasks` lists them), "module:Class", or a class derived from `dexsim.tasks.Task`.
        worlds: hands simulated at once; None: what fits the machine.
        device: "cpu", "cuda", "cuda:1"; None: cuda where there is one.
        seed: of everything random.
        settings: "key=value" each, as on the command line; they come last.
        checkpoint: the environment that this policy was trained in; `task` is then not used.
        hand: a name, or a folder with a hand.yaml. servo: a servo.yaml. objects, kept_out: shapes and mesh files to
            train with, and to be judged with. rewards: weights of terms by name.

    Returns:
        `get_observations()` -> a TensorDict of groups [N, D] float32; `step(actions [N, A] in [-1, 1])` ->
        (observations, rewards [N], dones [N], extras); `describe()` lists what each column is, with units.
    """
    from dexsim.cli import machine
    from dexsim.learning.ranks import seed_all
    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import make_env as make

    own = _things(hand, servo, objects, kept_out, rewards)
    begun = _start(task, worlds, device, seed, [*own, *settings], checkpoint)
    cfg = begun.cfg
    seed_all(cfg["seed"])
    machine.set_threads(cfg["device"])
    quiet_warp(cfg["device"])
    env: HandTask = make(cfg, cfg["worlds"], cfg["device"], cfg["seed"], cfg["sim"]["engine"])
    env.given = begun.given
    return env


def load_policy(checkpoint: File, env: HandTask) -> Policy:
    """Return the trained actor of a checkpoint, deterministic: observations of `env` -> actions [N, A].

    Raises:
        UserError: no checkpoint, a damaged one, or one of another layout of observations than the environment's.
    """
    from dexsim.learning import checkpoint as checkpoints
    from dexsim.learning.ppo import load_policy as load

    data = checkpoints.load(checkpoint, str(env.device))
    checkpoints.check_layout(data, checkpoints.layout_of(env), str(checkpoint))
    policy: Policy = load(data, env, str(checkpoint))
    return policy


def train(
    task: Task = "grasp", worlds: int | None = None, iterations: int | None = None, device: str | None = None,
    seed: int = 1, settings: Sequence[str] = (), out: File | None = None, *, agent: PPO | Distillation | None = None,
    hand: File | None = None, servo: File | None = None, objects: Sequence[File] | None = None,
    kept_out: Sequence[File] | None = None, rewards: Mapping[str, float] | None = None, resume: File | None = None,
    final_episodes: int | None = None,
) -> Path:  # fmt: skip
    """Train a policy as `dexsim train` does, with its printout; returns the run's folder.

    Args:
        iterations: of learning; None: what fits the machine. The others as `make_env`.
        out: the run's folder; None: runs/<task>/<date and time>.
        agent: what learns; None: the settings' own.
        resume: last.pt of a run to go on from.
        final_episodes: played and filmed at the end; 0: none; None: as the settings have it.

    Returns:
        The folder with policy.pt, last.pt (to go on from), config.yaml, progress.csv, curves.png and play/.

    Raises:
        KeyboardInterrupt: stopped by Ctrl-C; what was learned is saved in the run's folder.
    """
    from dexsim.cli import folder
    from dexsim.cli import train as training

    own = [] if iterations is None else [f"iterations={iterations}"]
    own += [] if out is None else [_setting("out", out)]
    own += [] if resume is None else [_setting("resume", resume)]
    own += [] if final_episodes is None else [f"final_episodes={final_episodes}"]
    own += [] if agent is None else agent.settings()
    own += _things(hand, servo, objects, kept_out, rewards)
    begun = _start(task, worlds, device, seed, [*own, *settings])
    where = folder.for_run(begun.cfg)
    begun.cfg["out"] = str(where)
    if training.run(begun, where=where) != 0:
        raise KeyboardInterrupt(f"the training was stopped; {where / 'last.pt'} holds it")
    return where


def play(
    checkpoint: File | None = None, policy: str | None = None, task: Task = "grasp", episodes: int = 256,
    device: str | None = None, seed: int = 0, video: bool = False, settings: Sequence[str] = (),
    out: File | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Play episodes as `dexsim play` does, with its printout; returns the metrics (metrics.json as a dict).

    Args:
        checkpoint: policy.pt, last.pt or model_*.pt; its own settings hold where `settings` do not change them.
        policy: without a checkpoint: "random", "zero" or "scripted", at `task`.
        video: render video.mp4 too.
        settings: "key=value" each, as on the command line.
        out: folder for the results; None: beside the run, or out/<name>.
    """
    from dexsim.cli import play as playing
    from dexsim.cli import start

    argv = [f"episodes={episodes}", f"seed={seed}", f"video={str(video).lower()}", *settings]
    argv += [] if device is None else [f"device={device}"]
    argv += [] if out is None else [_setting("out", out)]
    argv += [] if checkpoint is None else [_setting("checkpoint", checkpoint)]
    argv += [] if policy is None else [f"policy={policy}", f"task={_named(task)}"]
    ready = start.for_play(argv, CONFIGS)
    assert ready is not None  # neither --help nor --cfg was asked
    playing.run(ready)
    metrics: dict[str, Any] = json.loads((playing.results(ready) / "metrics.json").read_text(encoding="utf-8"))
    return metrics


# -- what they share


def _start(
    task: Task, worlds: int | None, device: str | None, seed: int | None, settings: Sequence[str],
    checkpoint: File | None = None,
) -> Any:  # fmt: skip
    """Return the start of a run (`dexsim.cli.start.Start`) from named arguments and settings."""
    from dexsim.cli import start

    if isinstance(settings, str):
        raise UserError(f'settings={settings!r}: must be a list of "key=value", e.g. [{settings!r}]')
    for text in settings:
        if text.startswith("-"):
            raise UserError(f'{text!r} is no setting: write "key=value"')
    named = {"worlds": worlds, "device": device, "seed": seed}
    argv = [*(f"{k}={v}" for k, v in named.items() if v is not None), *settings]
    if checkpoint is not None:
        ready = start.for_play([_setting("checkpoint", checkpoint), *argv], CONFIGS)
    else:
        ready = start.for_train([f"task={_named(task)}", *argv], CONFIGS)
    assert ready is not None  # neither --help nor --cfg was asked
    return ready


def _things(
    hand: File | None, servo: File | None, objects: Sequence[File] | None, kept_out: Sequence[File] | None,
    rewards: Mapping[str, float] | None,
) -> list[str]:  # fmt: skip
    """Return keywords as settings."""
    out = [_setting(k, v) for k, v in (("hand", hand), ("servo_file", servo)) if v is not None]
    for key, names in (("objects", objects), ("kept_out", kept_out)):
        if names is not None:
            out.append(f"{key}=[{','.join(_setting('', name)[1:] for name in names)}]")
    return out + [f"task.rewards.{name}={weight}" for name, weight in (rewards or {}).items()]


def _named(task: Task) -> str:
    """Return a task as the command line has it; a class that is given may be used."""
    from dexsim.tasks import registry

    return task if isinstance(task, str) else registry.name_class(registry.where_of(task), task)


def _setting(key: str, path: File) -> str:
    """Return a path as a setting, quoted so that no character of it is taken for syntax."""
    text = str(path).replace("\\", "\\\\").replace("'", "\\'")
    return f"{key}='{text}'"


def _texts(paths: File | Sequence[File]) -> list[str]:
    return [str(paths)] if isinstance(paths, (str, Path)) else [str(p) for p in paths]


def _folder(path: File) -> Path:
    from dexsim.console import folders

    return folders.make(Path(path).expanduser(), "the folder")


def _silent(_: str) -> None:
    """Discard progress that nobody wants to see."""
