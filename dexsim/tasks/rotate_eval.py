"""Evaluation of the rotation task in the paper's words: consecutive successes of each trial, time per success, time to
fall.

A trial begins in a held pose and ends when the object is dropped or tips over, or at the cap (`task.evaluation.cap_s`);
nothing else ends it. The paper's table divides: its seconds per success are the mean time to fall over the mean
successes (84.3 / 25.1 = 3.36 in its first row, and so in every row), and so are ours. A capped trial counts with the
cap as its time, so the mean time to fall is a restricted mean. Intervals: bootstrap over trials, 95 %.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from dexsim import intervals
from dexsim.tasks import evaluation
from dexsim.tasks.stable_grasps import CUBE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from dexsim.tasks.rotate import RotateEnv

Policy = Callable[..., torch.Tensor]  # a TensorDict of observations -> actions [N, J]
Progress = Callable[[int, int, str], object]  # trials done, of how many, what is played

HEADER = ("Contact center", "Contact force", "Force weighted", "Orientation", "Cons. success trials (sorted)",
          "Average", "Median", "Succ. time (Ave.) s", "Time to fall (Ave.) s")  # fmt: skip
"""Columns of the paper's rotation table."""


PALMS = ("up", "side", "down")
"""Where the palm looks; `side`: gravity lies in the palm's plane, in any direction."""
TOUCH = 0.1  # N on anything but fingertips that counts as touching it


class Trials:
    """How a rotation is evaluated, for its environment to inherit."""

    evaluation = __name__
    camera: ClassVar[dict[str, Any] | None] = {
        "lookat": [0.05, 0.0, 0.04], "distance": 0.36, "azimuth": 250.0, "elevation": -50.0}
    objects: Any
    reached: Any

    def trial_facts(self) -> dict[str, torch.Tensor]:
        """Return what an evaluation keeps of each trial as it begins: its object, width m, mass kg."""
        return {"object": self.objects.variant, "edge": 2 * self.objects.size[:, 0], "mass": self.objects.mass}

    def trial_counts(self) -> dict[str, torch.Tensor]:
        """Return what an evaluation counts, step by step, while a trial lasts: goals."""
        return {"goals": self.reached}

    def of_trials(self, r: dict) -> dict:
        """Return further metrics of an evaluation, from the arrays [E] of its trials."""
        return {}


class TipTrials(Trials):
    """The same of a cube held by fingertips."""

    other_force: Any
    palm: Any
    dt: float

    def trial_facts(self) -> dict[str, torch.Tensor]:
        return super().trial_facts() | {"palm": self.palm, "friction": self.objects.friction}

    def trial_counts(self) -> dict[str, torch.Tensor]:
        return super().trial_counts() | {"other_steps": self.other_force > TOUCH}

    def of_trials(self, r: dict) -> dict:
        """Share of the time in which anything but fingertips touched; and every trial: its successes, seconds, end,
        palm, edge m, mass kg, friction, seconds in which anything but fingertips touched."""
        other = r["other_steps"] * self.dt
        rows = zip(
            r["successes"].tolist(), np.round(r["time"], 3).tolist(), r["end"].tolist(), r["palm"].tolist(),
            np.round(r["edge"], 4).tolist(), np.round(r["mass"], 4).tolist(), np.round(r["friction"], 3).tolist(),
            np.round(other, 3).tolist(), strict=True,
        )  # fmt: skip
        return {
            "touched_by_others": float(other.sum() / max(r["time"].sum(), 1e-9)),
            "trials": [[*a[:3], PALMS[a[3]], *a[4:]] for a in rows],
        }


def evaluate(env: RotateEnv, policy: Policy, episodes: int, seed: int, progress: Progress | None = None) -> dict:
    """Play `episodes` trials, `env.num_envs` at a time.

    policy: TensorDict of observations -> actions [N, J]. Returns {"metrics", "tables", "frames", "plots"}.
    """
    env.end_curriculum()
    cap = float(env.task["evaluation"]["cap_s"])
    r, kept_out, frames = evaluation.play_all(env, policy, episodes, seed, cap, progress, recorded=True)
    names = np.array([*env.end_names[:-1], "capped"])  # the last is the time that is over
    for x in [r] if kept_out is None else [r, kept_out]:
        x |= {"successes": x["goals"], "time": x["length_s"], "end": names[x["end"]]}
    if frames is not None:
        what = [f"{1000 * x:.0f} mm" if env.names[k] == CUBE else env.names[k]
                for x, k in zip(r["edge"], r["object"], strict=True)]  # fmt: skip
        frames["label"] = [f"{x}, {1000 * m:.0f} g" for x, m, _ in zip(what, r["mass"], frames["qpos"], strict=False)]
    resamples = env.task["evaluation"]["resamples"]
    metrics, *others = (
        summary(x["successes"], x["time"], x["end"] == "capped", cap, resamples, seed)
        for x in ([r] if kept_out is None else [r, kept_out])
    )
    if others:
        metrics["kept_out"] = others[0]
    metrics |= _by_object(env, [r] if kept_out is None else [r, kept_out])
    last = r["last_goals"].sum() * env.dt
    metrics["seconds_between_successes"] = float(last / r["successes"].sum()) if r["successes"].sum() else None
    metrics["ends"] = {name: int((r["end"] == name).sum()) for name in names.tolist()}
    metrics |= env.of_trials(r)
    plots = [("successes", partial(_successes_plot, successes=r["successes"])),
             ("survival", partial(_survival_plot, time=r["time"], cap=cap))]  # fmt: skip
    return {"metrics": metrics, "tables": _tables(env, metrics), "frames": frames, "plots": plots}


def _by_object(env: RotateEnv, parts: list[dict]) -> dict:
    """Return successes in a row by object, where there is more than one."""
    if len(env.names) < 2:
        return {}
    which, count = (np.concatenate([p[k] for p in parts]) for k in ("object", "successes"))
    return {
        "successes_by_object": {
            name: float(count[which == k].mean()) for k, name in enumerate(env.names) if (which == k).any()
        }
    }


def summary(successes: np.ndarray, time: np.ndarray, capped: np.ndarray, cap: float, resamples: int, seed: int) -> dict:
    """Return metrics of E trials: successes [E], time [E] s until the fall or the cap, capped [E] bool."""
    successes, time = np.asarray(successes), np.asarray(time, float)
    average, median, per, fall = intervals.draws((successes, time), _statistics, seed, max(int(resamples), 1))
    total = successes.sum()
    return {
        "episodes": len(successes),
        "consecutive_successes": {
            "average": float(successes.mean()), "median": float(np.median(successes)),
            "all": sorted(int(x) for x in successes),
            "average_interval": _interval(average), "median_interval": _interval(median),
        },
        "seconds_per_success": float(time.sum() / total) if total else None,
        "seconds_per_success_interval": _interval(per),
        "seconds_to_fall": float(time.mean()), "seconds_to_fall_interval": _interval(fall),
        "capped": int(np.asarray(capped).sum()), "cap_s": cap, "share_without_success": float((successes == 0).mean()),
    }  # fmt: skip


def _statistics(successes: np.ndarray, time: np.ndarray, axis: int = -1) -> np.ndarray:
    """Average and median of the successes, seconds a success (infinite where there is none), seconds to fall."""
    with np.errstate(divide="ignore"):
        per = time.sum(axis) / successes.sum(axis)
    return np.stack([successes.mean(axis), np.median(successes, axis), per, time.mean(axis)])


def _interval(x: np.ndarray) -> list[float | None]:
    """Return 2.5 and 97.5 percentiles; None where infinite."""
    low, high = np.percentile(x, [2.5, 97.5], method="nearest")
    return [float(v) if np.isfinite(v) else None for v in (low, high)]


def row_of(env: RotateEnv) -> tuple[str, ...]:
    """Return the four settings of a row of the paper's table."""
    o = env.task["observe"]
    none = env.task["perception"] == "proprioception"
    return (
        *("yes" if o[k] and env.pads else "-" for k in ("contact_centre", "contact_force")),
        "yes" if o["contact_centre"] and o["force_weighted"] and env.pads else "-",
        {"6d": "6D", "quaternion": "Quaternion", "none": "-"}["none" if none else o["orientation"]],
    )


def _tables(env: RotateEnv, m: dict) -> list:
    c = m["consecutive_successes"]
    spread = (
        c["all"] if len(c["all"]) <= 12 else np.percentile(c["all"], np.linspace(5, 95, 10), method="nearest").tolist()
    )
    seconds = "-" if m["seconds_per_success"] is None else f"{m['seconds_per_success']:.2f}"
    listed = ",".join(str(int(x)) for x in spread) + ("" if len(c["all"]) <= 12 else " (5, 15 .. 95 %)")
    line = (*row_of(env), listed, f"{c['average']:.1f}", f"{c['median']:.1f}", seconds, f"{m['seconds_to_fall']:.1f}")
    intervals = [
        ("average", f"{c['average']:.2f}", _range(c["average_interval"])),
        ("median", f"{c['median']:.1f}", _range(c["median_interval"])),
        ("seconds per success", seconds, _range(m["seconds_per_success_interval"])),
        ("seconds to fall", f"{m['seconds_to_fall']:.1f}", _range(m["seconds_to_fall_interval"])),
    ]  # fmt: skip
    kept_out = m.get("kept_out")
    if kept_out is not None:
        intervals.append(
            ("average, objects kept out", f"{kept_out['consecutive_successes']['average']:.2f}",
             _range(kept_out["consecutive_successes"]["average_interval"]))
        )  # fmt: skip
    by = [(name, f"{value:.1f}") for name, value in m.get("successes_by_object", {}).items()]
    own = [("Successes in a row by object", ("object", "average"), by)] if by else []
    return [
        ("In-hand rotation (the paper's columns)", HEADER, [line]),
        ("95 % intervals (bootstrap over trials)", ("quantity", "value", "interval"), intervals),
        *own,
        evaluation.ends_table("trials", m, f" (cap {m['cap_s']:g} s)"),
    ]


def _range(pair: list) -> str:
    return " .. ".join("inf" if v is None else f"{v:.2f}" for v in pair)


def _successes_plot(ax: Axes, successes: np.ndarray) -> None:
    ax.plot(np.linspace(0, 100, len(successes)), np.sort(successes), drawstyle="steps-mid")
    ax.axhline(successes.mean(), linestyle="--", linewidth=1, color="0.4", label=f"average {successes.mean():.1f}")
    ax.set_xlabel("trials, sorted [%]")
    ax.set_ylabel("consecutive successes")
    ax.set_title("Successes of each trial")
    ax.legend()


def _survival_plot(ax: Axes, time: np.ndarray, cap: float) -> None:
    t = np.sort(time)
    fallen = t < cap
    turning = 100 * (1 - np.arange(1, fallen.sum() + 1) / len(t))
    ax.step([0, *t[fallen], cap], [100, *turning, 100 * (~fallen).mean()], where="post")
    ax.set_xlabel("time [s]")
    ax.set_ylabel("trials still turning [%]")
    ax.set_ylim(0, 102)
    ax.set_title("Time to fall")
