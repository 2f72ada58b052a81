"""One replay from resolved settings to metrics and video."""

from __future__ import annotations

import contextlib
from pathlib import Path

from dexsim import outputs
from dexsim.cli import build, machine
from dexsim.cli.replay import METRICS, VIDEO, replay
from dexsim.cli.start import Start
from dexsim.console.stop import Stop
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy, plain_policy


def run(start: Start, make_env: build.MakeEnv | None = None) -> int:
    """Play; returns the exit status. Raises UserError."""
    cfg, play = start.cfg, start.play
    if play.get("replay"):
        from dexsim.cli import recorded

        return recorded.run(play)
    out = outputs.claim(results(start), "out=", () if play["view"] else (METRICS, *((VIDEO,) if play["video"] else ())))
    what = start.source or f"policy {play['policy']}"
    env = build.build_env(cfg, make_env, {"policy": what, "results": out}, start.given)
    env.dump_folder = out  # for worlds that were not finite
    if start.data is not None:
        checkpoint.check_layout(start.data, checkpoint.layout_of(env), str(start.source))
        print(f"policy   {checkpoint.provenance(start.data)}", flush=True)
        policy = load_policy(start.data, env, str(start.source), start.typed, float(play["noise"]))
        about = {
            "checkpoint": str(start.source), "iteration": start.data["iteration"], "git": start.data["git"],
            "trained_with": start.data["versions"], "versions": machine.versions(),
        }  # fmt: skip
    else:
        policy = plain_policy(str(play["policy"]), env, cfg["seed"])
        about = {"policy": play["policy"], "versions": machine.versions()}
    if play["view"]:
        from dexsim.cli import live

        try:
            return live.run(start, env, policy)
        finally:
            build.close(env)
    print(f"playing {play['episodes']} episodes", flush=True)
    recorder = None
    if play["record"] is not None:
        from dexsim.recording.tap import PlayRecorder

        recorder = PlayRecorder(env, play["record_worlds"], cfg)
        recorder.claim(play["record"])  # a place that cannot be written is answered before the play
    with Stop() as stop, contextlib.ExitStack() as open_:
        open_.callback(build.close, env)
        try:
            replay(env, policy, out, play["episodes"], play["seed"], play["video"], about)
        except KeyboardInterrupt:
            saved = "; what was recorded until now is kept" if recorder is not None else ""
            print(f"\nbroken off{saved}", flush=True)
        else:
            stop.status = 0
        finally:
            stop.gently = True  # a second signal does not cut the recording
            if recorder is not None:
                for path in recorder.save(play["record"], bool(play["realistic"]), play["seed"]):
                    print(f"mcap     {path}", flush=True)
        return stop.status


def results(start: Start) -> Path:
    """Return ``out``; else play/ beside a run's checkpoint, else out/<checkpoint> or out/<task>_<policy>."""
    if start.play["out"] is not None:
        return Path(str(start.play["out"])).expanduser()
    if start.source is None:
        return Path("out") / f"{start.cfg['choices']['task']}_{start.play['policy']}"
    source = Path(start.source)
    if (source.parent / "config.yaml").is_file():
        return source.parent / ("play" if source.stem in ("policy", "last") else f"play_{source.stem}")
    return Path("out") / source.stem
