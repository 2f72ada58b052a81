"""``play.py replay=FILE``: the simulated mechanism driven by a recording's commands, beside what was recorded."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import outputs, typed
from dexsim.console.tables import table
from dexsim.errors import UserError

KEYS = (
    "replay", "model", "servo", "servo_file", "out", "video", "timestep", "hold", "start", "end", "hand", "hand_mirror",
    "object", "object_size", "object_mass", "object_friction",
)  # fmt: skip
RESULTS = ("metrics.json", "simulated.mcap", "position.png", "effort.png", "force.png", "video.mp4")


def settings(argv: list[str], config_dir: Path) -> dict[str, Any]:
    """Return the settings of a replay: {"replay": path, "model", "servo": path or None, "hand": a
    Hand or None, "out", "video", "timestep", "hold", "start", "end", "object":
    a `led_object.Stated` or None, "remap", "meta"}."""
    from dexsim.recording.arguments import read_arguments
    from dexsim.recording.mechanism import stated_hand

    own = typed.settings(argv, KEYS, ("remap.", "meta.", "units."))
    rest = [f"{key}={own.pop(key)}" for key in [*own] if key not in KEYS]
    _, remap, meta = read_arguments([own["replay"], *rest])
    for key in ("video", "hand_mirror"):
        typed.truth(key, own.get(key, "true"))
    if own.get("model") and ("hand" in own or "hand_mirror" in own):
        raise UserError(f"model={own['model']}: is not simulated beside hand=; say one of them")
    typed.one_of("hold", own.get("hold", "recorded"), ("recorded", "limp"))

    def seconds(key: str, low: float, high: float) -> float | None:
        return typed.number(key, own[key], low, high, "s") if key in own else None

    timestep, start, end = seconds("timestep", 1e-4, 0.02), seconds("start", 0.0, 1e6), seconds("end", 0.0, 1e6)
    servo = own.get("servo_file") or own.get("servo")
    if servo is not None and not servo.endswith((".yaml", ".yml")):
        path = config_dir / "servo" / f"{servo}.yaml"
        if not path.is_file():
            options = sorted(p.stem for p in (config_dir / "servo").glob("*.yaml"))
            raise UserError(f"servo={servo}: must be a servo.yaml file, or one of {', '.join(options)}")
        servo = str(path)
    return {
        "replay": own["replay"], "model": own.get("model") or None,
        "hand": stated_hand(own.get("hand"), own.get("hand_mirror") == "true"), "servo": servo,
        "out": own.get("out") or None, "video": own.get("video", "true") == "true", "timestep": timestep,
        "hold": own.get("hold", "recorded"), "start": start or 0.0, "end": end, "object": _object(own), "remap": remap,
        "meta": meta,
    }  # fmt: skip


def _object(own: dict[str, str]) -> Any:
    """Return what the recorded object is, as stated; None where nothing is."""
    from dexsim.recording.led_object import Stated

    rest = [k for k in ("object_size", "object_mass", "object_friction") if k in own]
    if "object" not in own:
        if rest:
            raise UserError(f"{rest[0]}={own[rest[0]]}: say object=SHAPE too")
        return None
    values: dict[str, Any] = {}
    for key in rest:
        numbers = tuple(typed.real(x) for x in own[key].strip("[]").replace(",", " ").split())
        low, high = {"object_size": (1e-3, 1.0), "object_mass": (1e-4, 10.0), "object_friction": (0.01, 5.0)}[key]
        if not numbers or not all(low <= x <= high for x in numbers) or (key != "object_size" and len(numbers) > 1):
            raise UserError(
                f"{key}={own[key]}: must be {'numbers' if key == 'object_size' else 'a number'}"
                f" from {low:g} to {high:g}"
            )
        values[key.removeprefix("object_")] = numbers if key == "object_size" else numbers[0]
    stated = Stated(own["object"], **values)
    stated.about()  # answers what is impossible
    return stated


def run(play: dict[str, Any]) -> int:
    """Read, simulate, compare; writes position.png, effort.png, force.png, metrics.json, simulated.mcap and
    video.mp4."""
    from dexsim.gap.read.channels import own_readings
    from dexsim.recording import attached, audit, compare, led_object, mechanism
    from dexsim.recording.reader import read
    from dexsim.recording.writer import write
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    path = Path(play["replay"]).expanduser()
    model, hand = play["model"], play["hand"]
    known = model is not None or hand is not None
    of = mechanism.mechanism(model, play["servo"] or {}, hand=hand) if known else None
    joints, ranges = (None, None) if of is None else (of.joints, of.ranges)
    recording = read(path, play["remap"], play["meta"], joints=joints, hand=hand, limits=ranges)
    print(audit.summary(recording))
    if recording.findings:
        print(audit.table(recording.findings))
    m = mechanism.for_recording(recording, model, play["servo"], hand)
    recording = mechanism.driven(recording, m)
    sim = attached.config(recording.config, recording.path).sim
    timestep = play["timestep"] or (sim and sim.timestep) or mechanism.STEP
    placed = led_object.add_object(m, recording, play["object"])
    led = placed == "led"
    if play["object"] is not None and not led:
        raise UserError(
            f"object={play['object'].shape}: recording {path} has no /object_pose in the palm frame"
            " for it, or model= is not a hand"
        )
    out = outputs.claim(
        Path(play["out"]).expanduser() if play["out"] else Path("out") / f"replay_{path.stem}", "out=", RESULTS, [path]
    )
    print(
        f"\nsimulating {recording.duration:.1f} s of {m.robot}, physics step {timestep * 1e3:g} ms"
        + {
            "led": ", the object led along its recorded path",
            "none": "",
            "marked": ", the object marked by a ball that nothing feels: say its shape with"
            " object=box object_size=0.05,0.05,0.05",
        }[placed],  # fmt: skip
        flush=True,
    )
    pairs = led_object.pairs(m.hand) if led and m.hand is not None else ()
    start, hold = play["start"], play["hold"]
    follow = led_object.JOINT if placed != "none" else None
    result = mechanism.replay(recording, m, timestep, pairs, follow, hold, start, play["end"])
    c = compare.compare(recording, result, m, forces=led)
    c.own = np.stack([own_readings(c.t, x) for x in c.position.T], 1) if len(c.t) else None
    position, effort = c.position_rmse(), c.effort_rmse()
    held = mechanism.held_joints(m, c.joints) if hold == "recorded" else []
    rows = [
        (j, "as recorded" if j in held else f"{1e3 * p:.2f}", f"{e:.4f}" if e == e and j not in held else "-")
        for j, p, e in zip(c.joints, position, effort, strict=True)
    ]
    free = [k for k, j in enumerate(c.joints) if j not in held]
    together = math.sqrt(float(np.nanmean(c.missed[:, free] ** 2))) if free else math.nan
    if len(free) > 1:
        rows.append((f"all {len(free)} that run free", f"{1e3 * together:.2f}", ""))
    print("\n" + table("recorded against simulated", ("joint", "position RMSE mrad", "torque RMSE N.m"), rows) + "\n")
    about = {
        "replay": str(path), "model": model or m.robot, "timestep_s": timestep, "object": placed,
        "start_s": float(result.t[0]), "follow_their_recording": held, "position_rmse_rad": _plain(c.joints, position),
        "position_rmse_all_rad": together if together == together else None, "torque_rmse_Nm": _plain(c.joints, effort),
        "current_per_torque": _plain(c.joints, c.effort_scale),
        "current_per_torque_fitted": [j for j, f in zip(c.joints, c.fitted, strict=True) if f],
        "findings": [f"{f.severity}: {f.kind} {f.topic} {f.text}".strip() for f in recording.findings],
    }  # fmt: skip
    with outputs.staged(out) as stage:
        (stage / "metrics.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        sent = recording.commands.between(start, np.inf if play["end"] is None else play["end"])
        write(stage / "simulated.mcap", mechanism.recorded(result, m, sent, recording.joints))
        drawn = compare.plots(c, stage, path.name)
    print(f"metrics  {out / 'metrics.json'}\nmcap     {out / 'simulated.mcap'}")
    for plot in drawn:
        print(f"plot     {out / plot.name}")
    if play["video"]:
        with outputs.staged(out) as stage:
            made = _video(recording, result, m, c, stage / "video.mp4")
        if made:
            print(f"video    {out / 'video.mp4'}")
    return 0


def _plain(joints: tuple[str, ...], values: Any) -> dict[str, float | None]:
    return {j: float(v) if v == v else None for j, v in zip(joints, values, strict=True)}


def _video(recording: Any, result: Any, m: Any, c: Any, path: Path) -> bool:
    """Return the recorded posture beside the simulated one; whether it could be made."""
    import mujoco

    from dexsim.console.ticker import Ticker
    from dexsim.view.video import Clip, drawn, render

    model = m.spec.compile()
    frames = result.t[0] + np.arange(len(result.qpos)) * result.frame_s
    clips = []
    address = [model.jnt_qposadr[model.joint(j).id] for j in recording.joints]
    state = recording.states.position
    force: list[np.ndarray | None] = [None, None]
    names: tuple[str, ...] = ()
    if c.force_unit == "N" and (c.finger_force is not None or c.finger_force_simulated is not None):
        names = m.hand.finger_names if m.hand else ()
        force = [
            None if s is None else np.stack([np.interp(frames, s[0], x) for x in s[1].T], 1)
            for s in (c.finger_force, c.finger_force_simulated)
        ]
    if len(state):
        seen, read = result.qpos.copy(), state.at(frames)
        seen[:, address] = np.where(np.isnan(read), seen[:, address], read)
        clips.append(Clip(model, seen, "recorded", force[0]))
    clips.append(Clip(model, result.qpos, "simulated", force[1]))
    camera = None
    if m.hand is None:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        camera = {
            "lookat": [float(x) for x in model.stat.center],
            "distance": 2.2 * float(model.stat.extent),
            "azimuth": 120.0,
            "elevation": -20.0,
        }
    return drawn(lambda: render(clips, path, result.frame_s, names, camera=camera, progress=Ticker("frames")))
