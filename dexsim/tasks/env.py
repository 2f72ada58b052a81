"""The step loop that every task shares: servo, physics, touch, terminations, rewards, masked reset, observations.

    action --scale, clip--> targets --[ servo | physics ] x K, touch--> terminations -> rewards -> reset -> observations

The scene is built by `building.py`, episodes begin by `episodes.py`, checkpoints keep what `keeping.py` says. Nothing
here reads from the device: decisions are masks, buffers live as long as the environment.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
import warp as wp
from tensordict import TensorDict

from dexsim import typed
from dexsim.errors import UserError
from dexsim.sim import warmup
from dexsim.tasks import state_kernels
from dexsim.tasks.keeping import Kept
from dexsim.tasks.nan_dump import NanDump
from dexsim.tasks.recorded import unrecordable
from dexsim.tasks.structs import filled
from dexsim.tasks.watched import unread

MOST_NAN = 0.2
"""Share of world-steps that may be not finite between two calls of `HandEnv.check`."""


class HandEnv(Kept):
    """N hands with one object each. A task subclasses it; see `tasks/grasp.py`.

    Shapes: actions [N, J] in [-1, 1]; observations a TensorDict of "actor" [N, A] and "critic" [N, C]; rewards and
    dones [N]. J joints, F fingers, P touch pads (F and those of its skin, or 0 without touch) in the hand's order.
    Positions are in the palm frame, which is the world frame (the hand is fixed; gravity turns). `unit`: the hand's
    span over UNIT_SPAN; `rise`: m by which its palm is higher than that of the hand that heights in settings are for.
    """

    # what `Task` has: named ends, bool [N]; named rewards, weighted [N]; words of each reward; scalars for the log;
    # tables of the first screen; bounds of figures of rewards' shapes
    setup: Callable[[], None]
    before_physics: Callable[[], None]
    terminated: Callable[[], dict[str, torch.Tensor]]
    rewards: Callable[[], dict[str, torch.Tensor]]
    reward_words: Callable[[], dict[str, str]]
    metrics: Callable[[], dict[str, torch.Tensor]]
    describe: Callable[[], dict[str, Any]]
    shapes: ClassVar[Mapping[str, tuple[float, float]]]

    def __init__(self, cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto"):
        super().__init__(cfg, n_worlds, device, seed, engine)
        self._late = dict((self.task.get("late") or {}).items())  # what of the rewards changes late in a training
        self._check_rewards()
        self._kernels()
        self._nan_dump, self.dump_folder = NanDump(self), Path()
        self.setup()
        warmup.begin(self._name_kernels, device)
        warmup.finish()
        self.reset_all()
        self._check_widths()

    def _check_rewards(self) -> None:
        """Raise UserError for a weight of a reward that the task does not know or that is no number, and for a figure
        of a reward's shape outside `shapes`."""
        known, file = self.reward_words(), type(self).__module__
        if self._late:
            typed.number("task.late.from", self._late["from"], 0.0, 1.0)
        for where, group in (("reward", self.task.get("reward", {})), ("late.reward", self._late.get("reward", {}))):
            for name, (low, high) in self.shapes.items():
                if name in group:
                    typed.number(f"task.{where}.{name}", dict.get(group, name), low, high)  # not watched: checks only
        weights = [("rewards", *item) for item in self.task["rewards"].items()]
        for where, name, weight in weights + [("late.rewards", *x) for x in self._late.get("rewards", {}).items()]:
            if name not in known:
                raise UserError(
                    f"task.{where}.{name}={weight}: the task {self.task['name']} has no reward of this name, or no"
                    f" words for it in `reward_words` of its file; it has {', '.join(sorted(known))} ({file})"
                )
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not math.isfinite(weight):
                raise UserError(f"task.{where}.{name}={weight}: must be a finite number; 0 leaves it out ({file})")

    @classmethod
    def prepare(cls, cfg: dict, **given: Any) -> None:
        """Make what the task of this configuration must find before it is built. given: arguments of the class."""

    def _check_given(self) -> None:
        """Raise UserError for one of the settings `given`, or without those that its class brings, that nothing has
        read: it would change nothing."""
        mine = [k for k in self.given if k.startswith(("task.", "randomize."))] or (self._own if self.learning else ())
        self.given = self._own = ()
        read = self.task.read | {f"randomize.{name}" for name in self.sampler.read}
        later = ("task.evaluation", "task.presets", "task.objects.emphasis")
        for key in unread(read, [k for k in mine if not k.startswith(later)]):
            raise UserError(
                f"{key}: nothing reads this setting, with the others as they are, so that it would change nothing;"
                " leave it out, or switch on what it belongs to (of a task's own class: read it in prepare_task)"
            )

    def _check_widths(self) -> None:
        """Raise UserError where a group of observations has not the columns that its table states."""
        for group, rows in self.describe()["observations"].items():
            stated, is_wide = sum(row[1] for row in rows), self.obs[group].shape[1]
            if stated != is_wide:
                raise UserError(
                    f"task {self.task['name']}: the {group} sees {is_wide} numbers, its table has {stated}"
                    f" ({', '.join(f'{row[0]} {row[1]}' for row in rows)}): make them equal"
                )

    @classmethod
    def another_world(cls, u: Callable[..., float], friction: float, size: float) -> dict[str, Any]:
        """Draw what of this task differs in another world to be judged in: "randomize", ranges by name, and "sensors".

        u(low, high, digits): a number. friction, size [m] of the object. See `dexsim.tasks.reality`."""
        return {}

    def trial_facts(self) -> dict[str, torch.Tensor]:
        """Return what an evaluation keeps of each episode as it begins, [N] each."""
        return {}

    def trial_counts(self) -> dict[str, torch.Tensor]:
        """Return what an evaluation counts, step by step, while an episode lasts, bool [N] each."""
        return {}

    def feel(self) -> None:
        """Sense after the last physics step of a control step: launches only, since it is recorded in the step's
        graph."""
        self.touch.launch()

    def symmetries(self) -> Sequence[Mapping[str, Callable[[torch.Tensor], torch.Tensor]]]:
        """Return situations that are as likely and end alike, beside the present one: for each, by name of a row of the
        observation, or "action", what makes its value [N, D] there of the present one; rows without stay as they are.
        `agent=ppo_symmetric` learns from them too."""
        return ()

    @property
    def max_episode_length(self) -> int:
        """Control steps after which an episode times out; on the device too, so that a recorded step sees a change."""
        return self._length

    @max_episode_length.setter
    def max_episode_length(self, steps: int) -> None:
        self._length = steps
        self._length_limit.fill_(steps)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since each episode began, [N]. Assigning copies: a recorded step holds this memory."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._episode_length.copy_(steps)

    def get_observations(self) -> TensorDict:
        return TensorDict({k: v.clone() for k, v in self.obs.items()}, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Return one control period. Returns (observations, rewards [N], dones [N], extras); worlds that ended are
        reset, and their observation is the new episode's first. extras: "time_outs" [N], "log" (means over worlds), and
        with `keep_final_obs` also "final_obs", the observations before the reset."""
        self._steps_since += 1
        self._action_in.copy_(actions)
        self._replay("before", self._before)
        substeps = self.decimation if self.reality is None else self.reality.substeps(self.decimation)
        self.engine.step(substeps, self.servo.before_each, self.feel)
        self._replay("after", self._after)
        if self.given or self._own:
            self._check_given()
        if self.keep_final_obs:
            final = {k: torch.nan_to_num(v, 0.0, 0.0, 0.0) for k, v in self.observe(advance=False).items()}
        self._replay("reset", self._reset_done)
        observations, reward, done, extras = self.results()
        if self.keep_final_obs:
            extras["final_obs"] = TensorDict(final, batch_size=[self.num_envs], device=self.device)
        return observations, reward, done, extras

    def results(self) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Return what `step` returns, copied: the next step writes over the environment's own."""
        assert self._log_values is not None  # since the first step
        log = dict(zip(self._log_names, self._log_values.clone().unbind(), strict=True))
        extras = {"time_outs": self.time_out.clone(), "log": log}
        return self.get_observations(), self.reward.clone(), self.done.to(torch.long), extras

    def _before(self) -> None:
        self.act(self._action_in)
        with self._drawn_ahead("orders"):
            self.before_physics()
        self._nan_dump.before()

    def _after(self) -> None:
        self.episode_length_buf += 1
        self.read_state()
        ends, terms = self.terminated(), self.rewards()
        if self._wrong is None:
            self._check_terms(ends, terms)
        rates, reward = self._judge(ends, terms)
        self._rates = rates
        self._nan_dump.after(self.nan)
        self._log(terms, ends, torch.cat([reward, rates]).mean(1))

    def _check_terms(self, ends: dict[str, torch.Tensor], terms: dict[str, torch.Tensor]) -> None:
        """Raise UserError for a term that is not one value for each world, or an end that is no truth value."""
        for kind, values in (("termination", ends), ("reward", terms), ("metric", self.figures)):
            for name, value in values.items():
                if value.shape != (self.num_envs,):
                    raise UserError(
                        f"{kind} {name}: has shape {list(value.shape)}, must be [{self.num_envs}]: one value for each"
                        " world (squeeze the last axis?)"
                    )
                if kind == "termination" and value.dtype != torch.bool:
                    raise UserError(f"termination {name}: gives {value.dtype}, must be bool (compare with a bound)")
        if not terms:
            name = self.task["name"]
            raise UserError(f"task {name}: has no reward; declare one, or give one a weight: task.rewards.NAME=1")
        self.end_names = (*ends, "nan", "time_out")

    def ended_by(self) -> torch.Tensor:
        """Index into `end_names` [N] of what ended the episodes that the last step ended."""
        at = len(self.end_names) - 2  # of nan, which goes before what else may be said of such a state
        return torch.where(self._rates[at] > 0, at, self._rates.argmax(0))

    def _judge(
        self, ends: dict[str, torch.Tensor], terms: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Fill `reward`, `done`, `time_out`. A world of which a reward or the last observation is not finite begins
        anew as one whose state is not; counts by state, term and group for `check`. Returns what ended each world, 1 or
        0 [E + 2, N] (`nan` and `time_out` last), and its rewards [T, N], 0 where it was not finite."""
        if self._wrong is None:
            self._sources = ("state", *(f"reward {k}" for k in terms), "observations")
            with torch.inference_mode(False):  # it outlives the rollout that happens to come first
                self._wrong = torch.zeros(len(self._sources), dtype=torch.long, device=self.device)
        reward = torch.stack(list(terms.values()))
        ended = torch.stack(list(ends.values())) if ends else self.nan[None][:0]
        rates = torch.empty(len(ends) + 2, self.num_envs, device=self.device)
        count = self.nan_count.view(1)
        given = filled(
            state_kernels.Ends, episode_length=self._episode_length, limit=self._length_limit.view(1),
            blind=self._blind[0], ends=ended,
        )  # fmt: skip
        out = filled(state_kernels.Ended, total=self.reward, done=self.done, time_out=self.time_out, rates=rates)
        inputs = [given, *map(wp.from_torch, (reward, self.nan, self._wrong, count)), out]
        wp.launch(state_kernels.judge, dim=self.num_envs, inputs=inputs, device=self.device)
        return rates, reward

    def _reset_done(self) -> None:
        if self.skip_idle_resets and not bool(self.done.any()):
            self._observe_all()
            return
        self.reset(self.done)

    def _replay(self, name: str, part: Callable[[], None]) -> None:
        """Run a part of the step. On CUDA it is recorded once (after two plain runs) and replayed: thousands of small
        kernels a second would otherwise keep the GPU waiting for Python. `graphs = False` runs it plainly, for whoever
        changes settings that a recording holds (evaluation does)."""
        if not (self.graphs and self.device.startswith("cuda")):
            part()
            return
        self._runs[name] = self._runs.get(name, 0) + 1
        if self._runs[name] <= 2:
            with self._constants:
                part()
            return
        graph = self._recorded.get(name)
        if graph is None:
            graph = torch.cuda.CUDAGraph()
            graph.register_generator_state(self.rng)
            now = torch.cuda.current_stream()
            recording = torch.cuda.graph(graph, stream=now, capture_error_mode="thread_local")
            with unrecordable(self.task["name"]), self._constants, recording:
                part()
            self._recorded[name] = graph
        graph.replay()

    def trained(self, share: float) -> None:
        """Learn that this share of a training is over: `task.late` may change shapes and weights of rewards."""
        if self._late and share >= self._late["from"]:
            for part in ("reward", "rewards"):
                self.task[part].update(self._late[part])
            self._late = {}
            self.forget_recorded()

    def forget_recorded(self) -> None:
        """Record the step anew: what a recording holds beside tensors of the environment has changed."""
        self._runs.clear()
        self._recorded.clear()

    def act(self, actions: torch.Tensor) -> None:
        """Turn actions [N, J] into targets. `relative`: the target moves by action * scale a step, held within the
        joint limits and within `lead` of the measured angle (a driver can do the same); `absolute`: the action spans
        the joint's range."""
        act, reach = self.task["action"], self._reach
        reach.relative = act["mode"] == "relative"
        moves = float(act.get("scale", 0.0)), act.get("lead", 0.0)
        if moves != self._moves:
            self._moves = moves
            self._reaches[0, : len(self.hand.joints)] = moves[0]
            self._reaches[1, : len(self.hand.joints)] = self.lead()
        inputs = [wp.from_torch(actions.to(torch.float32)), reach, *self._act_args]
        wp.launch(state_kernels.act, dim=actions.shape, inputs=inputs, device=self.device)
        if self.reality is None:
            self.servo.send(self.target)
        else:
            late, arrives = self.reality.late(self.num_envs)
            self.servo.send(self.target, arrives, self.engine.t.time + late)

    def lead(self) -> torch.Tensor:
        """Return how far targets may run ahead of the measured angles [J] rad: what the task says, or, where that is
        null, to where the torque of the loosest drive that is drawn reaches its limit. A target that is farther away
        pushes no harder in simulation; on a hand that is stiffer than its model it does, and unwinding it takes time
        everywhere."""
        said, J = self.task["action"].get("lead", 0.0), len(self.hand.joints)
        if said is not None:
            return torch.full((J,), float(said), device=self.device)
        return torch.minimum(self.servo_random.saturation()[:J].float(), (self.q_high - self.q_low)[:J])

    def _log(self, terms: dict, ends: dict, means: torch.Tensor) -> None:
        """means: of the reward terms, of how worlds ended, over all worlds."""
        metrics = self.metrics()
        values = torch.cat([means, torch.stack(list(metrics.values()))]) if metrics else means
        if self._log_values is None:
            ended = [f"end/{k}" for k in (*ends, "nan", "time_out")]
            self._log_names = (*(f"reward/{k}" for k in terms), *ended, *metrics)
            with torch.inference_mode(False):  # it outlives the rollout that happens to come first
                self._log_values = torch.zeros(values.shape, device=self.device)
        self._log_values.copy_(values)

    def check(self) -> None:
        """Raise UserError if contacts were lost since the last call, or more than MOST_NAN of all world-steps were not
        finite; write a world that was not finite to `dump_folder` (a file nan_<k>.npz). Reads from the device: once an
        iteration."""
        path = self._nan_dump.write(Path(self.dump_folder))
        if path is not None:
            print(
                f"a world was not finite and began anew ({int(self.nan_count)} so far); one is kept in {path}: "
                f"dexsim nan-dump {path} repeats the step",
                flush=True,
            )
        self._check_share()
        self.engine.check_overflow()

    def _check_share(self) -> None:
        """Raise UserError where many worlds diverge, which a setting causes; a few cost their episodes only."""
        if self._wrong is None:
            return
        counts, steps = self._wrong.tolist(), self._steps_since * self.num_envs
        self._wrong.zero_()
        self._steps_since = 0
        if sum(counts) > MOST_NAN * steps and sum(counts) > 20:
            where = ", ".join(f"{k} {100 * n / steps:.0f} %" for k, n in zip(self._sources, counts, strict=True) if n)
            raise UserError(
                f"not finite in so many of the last {steps} world-steps that nothing is learned from them: {where};"
                " allowed"
                f" {100 * MOST_NAN:.0f} % in all. Look at what this task's settings of that name are, or lower"
                " sim.timestep"
            )

    def evaluate(
        self,
        policy: Callable[..., torch.Tensor],
        episodes: int = 256,
        seed: int = 0,
        progress: Callable[..., None] | None = None,
    ) -> dict:
        """Play episodes, as the module of the class' `evaluation` does; returns {"metrics", "tables", "frames"} and
        perhaps "plots"."""
        return importlib.import_module(self.evaluation).evaluate(self, policy, episodes, seed, progress)
